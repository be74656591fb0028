"""Geometry: frames and joints, and nothing that could be wrong about them.

Conventions, stated once: ``T_a_b`` (4, 4) maps coordinates in b to coordinates in a, so
``T_a_c = T_a_b @ T_b_c``. The tangent of a transform is ``[rx ry rz tx ty tz]`` and an increment
stands on the right: ``T_a_b @ exp(xi)`` with ``xi`` in the axes of b. Metres and radians.
"""
