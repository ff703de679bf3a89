"""Plans: what to expect of a test before it is made."""
