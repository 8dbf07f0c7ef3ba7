"""Other trackers on the same frames, one file each; every one that pip installed takes part."""
