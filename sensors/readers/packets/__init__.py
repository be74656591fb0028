"""Packets of LiDARs, out of captures, decoded into turns."""
