"""A differentiable mesh renderer for many deformed copies of one mesh, on the CPU."""
