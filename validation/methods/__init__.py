"""Methods: named functions from an experiment to a measurement, and what they cost on the machine."""
