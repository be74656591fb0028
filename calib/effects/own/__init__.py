"""Effects of a user's own: formulas in YAML, classes in Python."""
