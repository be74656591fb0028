"""What is bolted to what, and what a recording holds."""

from calib.rig.description import Rig, TargetSpec, load_rig

__all__ = ["Rig", "TargetSpec", "load_rig"]
