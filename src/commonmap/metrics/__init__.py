"""What "similar" means: one table of metrics, each with its literal formula and its fast road."""

from commonmap.metrics.formulas import evidence_direct
from commonmap.metrics.table import METRICS, Metric, evaluate, find_metric

__all__ = ["METRICS", "Metric", "evaluate", "evidence_direct", "find_metric"]
