"""Procedural recordings: a furnished room, a smooth path, exact truth, a Kinect's noise."""

from pointslam.synth.record import Noise, SynthOptions, lit_room, record_scene, write_sequence

__all__ = ["Noise", "SynthOptions", "lit_room", "record_scene", "write_sequence"]
