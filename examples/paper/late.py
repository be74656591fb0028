"""What is wrong only while the arm moves."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.rig import Rig


class EncoderDelay(Effect):
    """Joints are read late: ``true = reported + delay * speed``."""

    name = "encoder_delay"
    site = Site.JOINTS
    unit = "s"
    formula = "q_i = reported_i + tau * rate_i"
    typical = "10 to 20 ms: a frame of the tracker and a cycle of the bus; size assumed"
    covariates = ("rate.<joint>",)
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("tau", "s", 0.02),) if rig.joint_names else ()

    def basis(self, view: View) -> np.ndarray:
        rates = [view[f"rate.{joint}"] for joint in view.rig.joint_names]
        return np.stack(rates, axis=1)[:, :, None]
