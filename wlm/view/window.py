"""A window that shows a scene: panels side by side, sliders below them, keys; on screen or as a picture."""

import os
import time
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need
from wlm.view.canvas import Canvas
from wlm.view.display import TONES
from wlm.view.pictures import save_png
from wlm.view.rendering import require_opengl
from wlm.view.scene import Scene, Slider, State

STRIP = 108
"""Height in pixels of the strip with the sliders at the bottom; at most half of the window's height."""

_HIDDEN = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")  # windows that VTK opens if there is no display
# Colours, first camera and perspective are those of the HTML pages, in their dark form.
_BACKGROUND, _STRIP, _INK, _BAR = "#1b1b1f", "#2c2c33", "#e8e8e8", "#ffb454"
_TITLE_PIXELS, _FONT, _TITLE_FONT = 26, 9, 10
# Positions in the strip, as fractions of its height and width.
_LABELS, _BARS, _CAPTION, _KEYS, _INDENT, _LEAST_CELLS = 0.76, 0.64, 0.30, 0.06, 0.01, 3
_EYE = (0.5654, 0.4794, 0.6712)  # direction of the first camera, with y up
_MARGIN, _VIEW_ANGLE = 1.0 / 0.93, 45.24  # degrees
_SWEEP = 12.0  # seconds to play a slider of real values once
_TICK = 30  # milliseconds
_EXPOSURE = Slider("exposure", -8.0, 8.0, 0.0, 0.5, "+.1f", unit=" EV")
_ERROR = Slider("error", 1.0, 64.0, 8.0, 1.0, ".0f", "×", whole=True, label="error factor")


class Window:
    """A window of a scene, with its sliders by name. `state` has the user's choices: change them with `set`, `choose`
    and `tone`; `playing` tells whether the scene is played."""

    def __init__(self, scene: Scene, *, size: tuple[int, int] = (1280, 720), off_screen: bool = True) -> None:
        """Makes the window, of a width and height in pixels, and draws the scene; it stays hidden if `off_screen`."""
        pyvista = need("pyvista", "view")
        require_opengl()
        self.scene, self.playing = scene, False
        common = [_EXPOSURE] + [_ERROR] * ("error" in scene.panels)
        self.sliders = {slider.name: slider for slider in (*scene.sliders, *common)}
        self.state = State({name: slider.value for name, slider in self.sliders.items()}, scene.views[0])
        count, self._share = len(scene.panels), min(STRIP / size[1], 0.5)
        layout = {"shape": (2, count), "groups": [(1, slice(None))], "row_weights": [1.0 - self._share, self._share]}
        # Off-screen rendering works without a display, so VTK's messages about it are suppressed.
        with pyvista.vtk_verbosity("off"):
            self._plotter = pyvista.Plotter(
                **layout, off_screen=off_screen, border=False, window_size=size, title=scene.title
            )
        if not off_screen and self._plotter.render_window.GetClassName() in _HIDDEN:
            self._plotter.close()
            raise WlmError("view: expected a display, found none; wlm view --screenshot needs none")
        self.canvas = Canvas(pyvista, self._plotter, count)
        self._widgets: dict[str, tuple[Any, Any]] = {}
        self._furnish()
        self.draw()
        self.look()

    def set(self, name: str, value: float) -> None:
        """Moves a slider; values outside its range are clamped."""
        if name not in self.sliders:
            raise WlmError(f"{self.scene.title}: {name} has no meaning for this file; it has {', '.join(self.sliders)}")
        if not np.isfinite(value):
            raise WlmError(f"{name}: expected a finite number, got {value}")
        self.state.values[name] = self.sliders[name].fit(value)
        self.draw()

    def choose(self, view: str) -> None:
        """Changes the view."""
        if view not in self.scene.views:
            raise WlmError(f"{self.scene.title}: --view: expected {' or '.join(self.scene.views)}, got {view}")
        self.state.view = view
        self.draw()

    def tone(self, name: str) -> None:
        """Changes the tone mapping."""
        if name not in TONES:
            raise WlmError(f"--tone: expected {' or '.join(TONES)}, got {name}")
        self.state.tone = name
        self.draw()

    def turn(self, degrees: float) -> None:
        """Turns the camera about the scene's upward axis."""
        if not np.isfinite(degrees):
            raise WlmError(f"turn: expected a finite number of degrees, got {degrees}")
        camera, axis = self.canvas.renderers[0].camera, np.eye(3)[self.scene.up]
        camera.up = axis
        camera.Azimuth(degrees)
        self._clip()

    def advance(self, seconds: float) -> None:
        """Advances the playing scene by some seconds: its hour, or else the camera's turn."""
        slider = self.sliders.get("hour")
        if slider is None:
            self.turn(360.0 * seconds / _SWEEP)
            return
        value = self.state.values["hour"] + (slider.high - slider.low) / _SWEEP * seconds
        if value > slider.high:
            value = slider.low + (value - slider.low) % (slider.high - slider.low)
        self.set("hour", value)

    def draw(self) -> None:
        """Redraws everything for the current state."""
        self.scene.draw(self.canvas, self.state)
        self._lay_out()
        panels, views, view = self.scene.panels, self.scene.views, self.state.view
        if len(panels) > 1:
            self.canvas.renderers[0].actors["title"].set_text("upper_edge", panels[0] if view == views[0] else view)
        chosen = "   ".join(f"[{i} {v}]" if v == view else f"{i} {v}" for i, v in enumerate(views, 1))
        parts = [f"view: {chosen}" if len(views) > 1 else "", self.scene.caption(self.state)]
        self._texts["caption"].SetInput("      ".join(filter(None, parts)))
        # Keys have no effect in a picture.
        self._texts["keys"].SetInput("" if self._plotter.off_screen else self.help())

    def picture(self) -> np.ndarray:
        """Renders the window, uint8 [H, W, 3]."""
        self._clip()
        self._plotter.render()
        return np.array(self._plotter.screenshot(return_img=True)[..., :3])

    def screenshot(self, path: str | os.PathLike[str]) -> None:
        """Writes the content of the window as a PNG, atomically."""
        save_png(path, self.picture())

    def show(self) -> None:
        """Shows the window until the user closes it."""
        interactor = self._plotter.iren
        interactor.initialize()
        if self.scene.flat:
            interactor.enable_2d_style()
        interactor.add_observer("TimerEvent", lambda *_: self._tick())
        interactor.create_timer(_TICK, repeating=True)
        self._plotter.show(auto_close=True)

    def close(self) -> None:
        """Closes the window."""
        self._plotter.close()

    def press(self, key: str) -> None:
        """Runs the action of a key, given by VTK's name."""
        if key in self._keys:
            self._keys[key]()
            self._plotter.render()

    def _furnish(self) -> None:
        plotter = self._plotter
        for number, title in enumerate(self.scene.panels):
            plotter.subplot(0, number)
            plotter.set_background(_BACKGROUND, all_renderers=False)
            if len(self.scene.panels) > 1:
                plotter.add_text(title, position="upper_edge", font_size=_TITLE_FONT, color=_INK, name="title")
        plotter.subplot(1, 0)
        plotter.set_background(_STRIP, all_renderers=False)

        def text(name: str, x: float, y: float) -> Any:
            return plotter.add_text("", position=(x, y), viewport=True, font_size=_FONT, color=_INK, name=name)

        self._texts = {"caption": text("caption", _INDENT, _CAPTION), "keys": text("keys", _INDENT, _KEYS)}
        colour = need("pyvista", "view").Color
        for name, slider in self.sliders.items():
            label = text(f"slider {name}", 0.0, _LABELS)
            widget = plotter.add_slider_widget(
                None, rng=(slider.low, slider.high), value=slider.value, interaction_event="always"
            )
            # The plotter's own callback would also run now, and turn errors into warnings.
            moved = lambda widget, _, name=name: self.set(name, widget.GetRepresentation().GetValue())  # noqa: E731
            widget.AddObserver("InteractionEvent", moved)
            shape = widget.GetRepresentation()
            shape.ShowSliderLabelOff()
            shape.SetSliderLength(0.02)
            shape.SetSliderWidth(0.16)
            shape.SetTubeWidth(0.04)
            shape.SetEndCapLength(0.0)
            shape.GetSliderProperty().SetColor(colour(_BAR).float_rgb)
            shape.GetTubeProperty().SetColor(colour(_INK).float_rgb)
            self._widgets[name] = widget, label
        self._keys = {
            "space": self._toggle,
            "t": lambda: self.tone(TONES[1 - TONES.index(self.state.tone)]),
            "r": self.look,
            "bracketleft": lambda: self._move("exposure", -1),
            "bracketright": lambda: self._move("exposure", 1),
            "minus": lambda: self._move("error", -1),
            "plus": lambda: self._move("error", 1),
            "Left": lambda: self._move(self._main(), -1),
            "Right": lambda: self._move(self._main(), 1),
        }
        for number, view in enumerate(self.scene.views, 1):
            self._keys[str(number)] = lambda view=view: self.choose(view)
        # The default keys of the plotter and VTK would switch to stereo and wireframe.
        plotter.iren.clear_key_event_callbacks()
        plotter.iren.interactor.RemoveObservers("CharEvent")
        plotter.add_key_event("q", plotter.iren.terminate_app)
        for key in self._keys:
            plotter.add_key_event(key, lambda key=key: self.press(key))

    def _shows(self, name: str) -> bool:
        views = self.sliders[name].views
        return not views or self.state.view in views

    def help(self) -> str:
        """One line about the keys that have an effect in this view."""
        moved, views = self._main(), len(self.scene.views)
        does = {
            "space": "plays" if "hour" in self.sliders else "turns",
            "arrows": moved,
            "[ ]": "exposure",
            "- +": "error" if "error" in self.sliders else None,
            "T": "tone",
            f"1 to {views}": "view" if views > 1 else None,
            "R": "first camera",
            "Q": "closes",
        }
        return "keys:   " + "   ".join(f"{key} {what}" for key, what in does.items() if what)

    def _lay_out(self) -> None:
        shown = [name for name in self.sliders if self._shows(name)]
        cell = 1.0 / max(len(shown), _LEAST_CELLS)
        for name, slider in self.sliders.items():
            widget, text = self._widgets[name]
            shape, value = widget.GetRepresentation(), self.state.values[name]
            shape.SetValue(value)
            shape.SetVisibility(name in shown)
            text.SetVisibility(name in shown)
            if name in shown:
                left = cell * shown.index(name)
                text.SetInput(slider.text(value) + f", {self.state.tone}" * (name == _EXPOSURE.name))
                text.SetPosition(left + _INDENT, _LABELS)
                for point, x in ((shape.GetPoint1Coordinate(), 0.0), (shape.GetPoint2Coordinate(), cell - 0.02)):
                    point.SetValue(left + _INDENT + x, _BARS * self._share)
            # The widget does not notice that its ends moved.
            shape.Modified()

    def _move(self, name: str | None, steps: int) -> None:
        if name in self.sliders:
            self.set(name, self.state.values[name] + steps * self.sliders[name].step)

    def _main(self) -> str | None:
        """Returns the name of the slider that arrow keys move: the scene's first slider in this view."""
        return next((slider.name for slider in self.scene.sliders if self._shows(slider.name)), None)

    def _toggle(self) -> None:
        self.playing, self._last = not self.playing, time.perf_counter()

    def _tick(self) -> None:
        if self.playing:
            now = time.perf_counter()
            self.advance(now - self._last)
            self._last = now
            self._plotter.render()

    def look(self) -> None:
        """Places the camera so that it sees the whole scene."""
        first = self.canvas.renderers[0]
        camera = first.camera
        camera.view_angle = _VIEW_ANGLE
        low, high = self.scene.box() or np.array(first.ComputeVisiblePropBounds()).reshape(3, 2).T
        middle = 0.5 * (low + high)
        x, y, z = _EYE
        toward, above = np.array([x, y, z] if self.scene.up == 1 else [x, -z, y]), np.eye(3)[self.scene.up]
        if self.scene.flat:
            toward, above = np.eye(3)[2], np.eye(3)[1]
        toward = toward / np.linalg.norm(toward)
        right = np.cross(above, toward)
        axes = np.stack([right, np.cross(toward, right), toward])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)]) - middle
        across, rise, near = axes @ corners.T
        width, height = first.GetSize()
        # The strip of titles stays free above, and below as well, since the scene is centred.
        free = max(height - 2 * _TITLE_PIXELS, 1) if len(self.scene.panels) > 1 else height
        reach = _MARGIN * np.maximum(np.abs(rise) * height / free, np.abs(across) * height / width)
        away = float((reach / np.tan(np.radians(camera.view_angle) / 2) + near).max())
        camera.focal_point, camera.up = middle, axes[1]
        camera.position = middle + max(away, 1e-6) * toward
        camera.parallel_projection, camera.parallel_scale = self.scene.flat, max(float(reach.max()), 1e-6)
        for renderer in self.canvas.renderers[1:]:
            renderer.camera = camera
        self._clip()

    def _clip(self) -> None:
        for renderer in self.canvas.renderers:
            renderer.ResetCameraClippingRange()
