"""The folder that a fit leaves behind, and what grows from it."""
