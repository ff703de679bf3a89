"""Timings of each stage, beside RTK and beside a plain implementation that stores the sensitivities."""
