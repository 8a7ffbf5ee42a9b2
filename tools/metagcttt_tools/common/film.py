"""Films of MuJoCo scenes: a renderer that says what is missing, and GIFs without flicker."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sim_bridge.opengl import rendering_help
from sim_bridge.simulator import SimulatorError

Picture = NDArray[np.uint8]


@contextmanager
def renderer(model: Any, size_px: tuple[int, int]) -> Iterator[Any]:
    """A MuJoCo renderer of pictures of `size_px`, (height, width), in even light.

    Raises:
        SimulatorError: If this machine cannot draw without a display; says what to set.
    """
    import mujoco

    model.vis.headlight.ambient[:] = 0.5  # OGBench's light is for small pictures
    try:
        opened = mujoco.Renderer(model, *size_px)
    except (mujoco.FatalError, ImportError, RuntimeError, AttributeError) as error:
        raise SimulatorError(f'{rendering_help()} ({error})') from error
    with opened:
        yield opened


def add_shape(
    scene: Any, kind: int, rgba: Sequence[float], at: Sequence[float], size: Sequence[float]
) -> Any:
    """One more shape in a scene: its kind (`mjtGeom`), colour, place and size, metres."""
    import mujoco

    scene.ngeom += 1
    shape = scene.geoms[scene.ngeom - 1]
    mujoco.mjv_initGeom(
        shape,
        kind,
        np.array(size, np.float64),
        np.array(at, np.float64),
        np.eye(3).ravel(),
        np.array(rgba, np.float32),
    )
    return shape


def write_film(path: Path, pictures: Sequence[Picture], frame_ms: int) -> None:
    """Write pictures (height, width, 3) as a GIF that repeats, `frame_ms` each."""
    from PIL import Image  # here, as not every installation has it, nor matplotlib

    from metagcttt_tools.common.plots import write_gif

    images = [Image.fromarray(picture) for picture in pictures]
    # One palette, that keeps the colours of small things too: colours shall not flicker.
    palette = images[0].quantize(64, Image.Quantize.MAXCOVERAGE)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    content = io.BytesIO()
    frames[0].save(
        content, 'GIF', save_all=True, append_images=frames[1:], duration=frame_ms, loop=0
    )
    write_gif(path, content.getvalue())
