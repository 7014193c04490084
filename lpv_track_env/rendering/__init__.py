"""Drawing of path tracking with pygame: frames as arrays, or a window; see `renderer`."""

from lpv_track_env.rendering.renderer import HEIGHT, WIDTH, Renderer
from lpv_track_env.rendering.scenery import Scenery

__all__ = ["HEIGHT", "WIDTH", "Renderer", "Scenery"]
