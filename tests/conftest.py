"""Settings that must stand before numpy is loaded: one BLAS thread, as the machine's cores are few
and threads that wait for each other cost more than they give on small matrices.

Property tests draw the same examples at each run, so that a change is judged by what it changes;
`pytest --hypothesis-profile=random` draws others, to look for what the fixed ones miss. A case that
is found so becomes an explicit `@example`.
"""

import os

from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

settings.register_profile("fixed", derandomize=True, database=None, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None)
settings.load_profile("fixed")
