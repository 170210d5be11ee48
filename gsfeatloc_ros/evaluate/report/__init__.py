"""The report of an evaluation: one HTML page that needs nothing else."""

from gsfeatloc_ros.evaluate.report.page import write_report

__all__ = ["write_report"]
