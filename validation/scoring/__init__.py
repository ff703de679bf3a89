"""Scores of a measurement against its truth, and whether its stated intervals hold."""
