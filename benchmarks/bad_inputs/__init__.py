"""Inputs that a user gets wrong, and what the command line answers: the table of docs/bad-inputs.md."""
