"""Several cameras that see the same ground: fuse them to one scene, and correct ground planes that disagree."""
