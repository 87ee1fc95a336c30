"""A differentiable mesh renderer for many deformed copies of one mesh, on the CPU."""

from render.camera import Camera as Camera
from render.pipeline import BUFFERS as BUFFERS
from render.pipeline import render as render
from render.pipeline import render_by_stages as render_by_stages
from render.shade import Light as Light
