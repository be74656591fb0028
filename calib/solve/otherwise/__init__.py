"""What scans of a mesh say of how else a recording may be read: turned, mirrored, or inverted."""
