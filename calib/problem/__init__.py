"""Every unknown, with its role and its owner; where each starts; blocks of rows."""

from calib.problem.build import build
from calib.problem.problem import Problem

__all__ = ["Problem", "build"]
