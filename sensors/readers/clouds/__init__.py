"""Clouds in files, one for each stop; the rings and origins of their beams."""
