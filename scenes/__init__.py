"""Built-in scenes: each module has `build(**parameters)` and `animate(scene, time)`."""
