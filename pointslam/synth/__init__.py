"""Procedural recordings: a furnished room, a smooth path, exact truth, a Kinect's noise."""

from pointslam.synth.record import Noise, SynthOptions, write_sequence

__all__ = ["Noise", "SynthOptions", "write_sequence"]
