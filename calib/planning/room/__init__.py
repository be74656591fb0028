"""Where a rig may stand and what its arm may do there: places, poses, and ways between them."""
