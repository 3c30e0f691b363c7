"""Settings that must stand before numpy is loaded: one BLAS thread, as the machine's cores are few
and threads that wait for each other cost more than they give on small matrices."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
