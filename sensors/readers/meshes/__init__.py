"""The surveyed room: meshes, a surveying scanner's clouds, calibration spheres."""
