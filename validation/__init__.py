"""Scores of a measurement against its truth, figures, reports and the command line."""

from pdvc_bench import check_namesakes

check_namesakes("pdvc", "simulator")
