"""Descriptions of an arm; what they mean is told in `chains.readers`."""
