"""Which physical effect is missing from a model, and what data hardly determine."""

from calib.diagnosis.verdict import Diagnosis

__all__ = ["Diagnosis"]
