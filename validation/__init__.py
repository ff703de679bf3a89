"""Scores of a measurement against its truth, figures, reports and the command line."""
