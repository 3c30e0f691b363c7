"""The report: one HTML page with everything that a person needs to judge a result."""

from commonmap.report.page import write_report

__all__ = ["write_report"]
