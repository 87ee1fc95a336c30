"""Operators on triangle meshes."""
