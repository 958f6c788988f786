"""The host side of a training: the loop, checkpoints, the run folder, devices, recovery."""
