"""Choice of an OpenGL library for MuJoCo on machines without a display."""

import ctypes.util
import os
import sys

HEADLESS_LIBRARIES = {'egl': 'EGL', 'osmesa': 'OSMesa'}
"""Values of MUJOCO_GL that need no display, best first, and the system library of each."""


def choose_opengl_library() -> None:
    """Set MUJOCO_GL for this process if it is unset and there is no display.

    MuJoCo reads the variable when it is first imported; later calls do nothing. Without a
    suitable library nothing is set, and rendering fails while the physics works.
    """
    if 'mujoco' in sys.modules:
        return
    has_display = os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
    if 'MUJOCO_GL' in os.environ or has_display or not sys.platform.startswith('linux'):
        return
    for value, library in HEADLESS_LIBRARIES.items():
        if ctypes.util.find_library(library):
            os.environ['MUJOCO_GL'] = value
            return


def rendering_help() -> str:
    """Advice for when rendering fails, in one sentence."""
    setting = os.environ.get('MUJOCO_GL', 'unset')
    return (
        f'MuJoCo cannot render here (MUJOCO_GL is {setting}): install EGL or OSMesa '
        '(libegl1 or libosmesa6 on Debian and Ubuntu) and set MUJOCO_GL to egl or osmesa '
        'before Python starts'
    )
