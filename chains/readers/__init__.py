"""Descriptions of an arm, read and written: URDF, xacro, Denavit and Hartenberg."""
