"""A stop that saw something else."""

from dataclasses import replace
from types import SimpleNamespace

from calib.residuals.scan import ScanStop
from calib.residuals.store import BeamStore
from sensors.recording import Scan


def rescanned(scan: ScanStop, read: Scan) -> ScanStop:
    """The stop with another scan in place of its own."""
    recording = SimpleNamespace(scan=lambda index: read)
    return replace(scan, store=BeamStore(recording, scan.store.beam_origin_m))
