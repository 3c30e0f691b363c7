"""Experiments: the source paper's, and which metric to use. A command of `commonmap study` each."""
