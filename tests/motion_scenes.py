"""Scenes and renderers of the tests of motion: a card that flies, a gallery that may be animated."""

import numpy as np
from builders import gallery, grid, tilt

import warp_deferred as wd

SIZE = (64, 48)


def settings_of(rung, *more):
    # The reach of ambient visibility is taken from the scene's box at load, so renderers made at two times differ.
    values = [f"motion_blur.rung={rung}", "motion_blur.samples=16", "ambient_visibility.rung=off"]
    return wd.Settings().with_values([*values, *more])


def renderer_of(device, rung="velocity_gather", outputs=("color", "display"), scene=None, more=(), **fields):
    size = {"width": SIZE[0], "height": SIZE[1]} | fields
    return wd.Renderer(scene or gallery(), device=device, outputs=outputs, settings=settings_of(rung, *more), **size)


def moving_scene():
    """A scene that says it can be animated, with an open shutter."""
    scene = gallery()
    scene.camera = scene.camera.replace(shutter=1.0)
    scene.animate = lambda scene, time: None
    return scene


def card(scene, x=0.0, z=-5.0, angle=0.0, size=1.0):
    """Place a square that faces the camera of `card_scene`."""
    place = tilt(move=(x, 0.0, z))
    c, s = np.cos(angle), np.sin(angle)
    return place @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def card_scene(**lens):
    scene = wd.Scene()
    glow = wd.Material(model="lambert", base_color=(0, 0, 0, 1.0), emissive=(1.0, 1.0, 1.0), two_sided=True)
    scene.add(grid(1, 2.0), transform=card(scene), material=glow)
    scene.camera = wd.Camera(shutter=1.0, **lens)
    scene.animate = lambda scene, time: None
    return scene
