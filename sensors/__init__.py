"""Measurement: what each instrument delivers, and how well."""
