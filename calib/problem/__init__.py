"""Every unknown, with its role and its owner; where each starts; blocks of rows."""

from calib.problem.build import Problem, build

__all__ = ["Problem", "build"]
