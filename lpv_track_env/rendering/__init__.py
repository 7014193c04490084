"""Drawing of path tracking with pygame: frames as arrays, or a window; see `renderer`."""

from lpv_track_env.rendering.renderer import Renderer
from lpv_track_env.rendering.scenery import Scenery
from lpv_track_env.rendering.style import HEIGHT, WIDTH
from lpv_track_env.rendering.track import COLOURINGS

__all__ = ["COLOURINGS", "HEIGHT", "WIDTH", "Renderer", "Scenery"]
