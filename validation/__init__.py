"""Scores of a measurement against its truth, figures, reports and the command line."""

from pdvc.surroundings import check_namesakes

check_namesakes("pdvc", "simulator")
