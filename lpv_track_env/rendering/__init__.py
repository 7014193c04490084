"""Drawing of path tracking with pygame, as arrays or in a window; see `renderer`."""

from lpv_track_env.rendering.canvas import HEIGHT, WIDTH
from lpv_track_env.rendering.renderer import Renderer
from lpv_track_env.rendering.track import COLOURINGS, Scenery

__all__ = ["COLOURINGS", "HEIGHT", "WIDTH", "Renderer", "Scenery"]
