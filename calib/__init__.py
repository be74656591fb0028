"""Inference: the only package that knows about error, probability and results."""
