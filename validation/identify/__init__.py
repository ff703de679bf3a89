"""Identification put to the test: many draws of an experiment whose law is known."""
