"""The studio: a synthetic multi-view capture whose truth is known exactly.

A clothed, procedurally textured body is posed by the body model and ray-cast with embree. It shares
no code with the radiance field's renderer, so that the truth is independent of what it judges.
"""

from ntop.captures.studio.capture import capture_studio

__all__ = ["capture_studio"]
