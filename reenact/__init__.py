"""Reenact: facial expression retargeting between blendshape rigs."""
