"""Base class of the scenes that a window shows: panels, sliders and views; one subclass for each kind of file."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from wlm.view.canvas import Canvas
from wlm.view.display import TONES, Display


@dataclass(frozen=True)
class Slider:
    """A slider below the picture, with its range and the format of its label.

    Attributes:
        name: Name of the command's option.
        low, high: Range of values.
        value: Initial value.
        step: Change by one key press.
        form: Format of the value in the label.
        unit: Text after the value in the label.
        whole: Whether only integers are allowed.
        wraps: Whether `high` is the same as `low`, as for hours of a day.
        clock: Whether the value is an hour of a day, which the label also shows as a clock time.
        views: Views in which it has an effect; empty for all.
        label: Name that is shown; empty for `name`.
    """

    name: str
    low: float
    high: float
    value: float
    step: float
    form: str = ".2f"
    unit: str = ""
    whole: bool = False
    wraps: bool = False
    clock: bool = False
    views: tuple[str, ...] = ()
    label: str = ""

    def text(self, value: float) -> str:
        """Returns the label that shows a value of the slider: name, number and unit, and the clock time of an hour."""
        shown = f"{self.label or self.name} {value:{self.form}}{self.unit}"
        minutes = round(value * 60.0) % 1440
        return f"{shown} ({minutes // 60}:{minutes % 60:02})" if self.clock else shown

    def fit(self, value: float) -> float:
        """Returns a value wrapped or clamped to the slider's range, and rounded if only integers are allowed."""
        if self.wraps and not self.low <= value <= self.high:
            value = self.low + (value - self.low) % (self.high - self.low)
        value = min(max(value, self.low), self.high)
        return float(round(value)) if self.whole else value


@dataclass
class State:
    """The user's choices: values of the sliders by name, a view of the scene, and one of `wlm.view.display.TONES`."""

    values: dict[str, float]
    view: str
    tone: str = TONES[0]

    def display(self, exposure: float) -> Display:
        """Returns how light is shown by the sliders of exposure and error; `exposure` is the factor at 0 EV."""
        return Display(exposure * 2.0 ** self.values.get("exposure", 0.0), self.tone, self.values.get("error", 1.0))


@dataclass
class Scene(ABC):
    """The content of one file in a window.

    Attributes:
        title: Title of the window.
        panels: Titles of the panels from left to right.
        views: Views of the first panel; the first view is the default.
        sliders: Sliders of the scene; the window adds those of exposure and error.
        flat: Whether the scene lies in a plane and the camera does not turn.
        up: Index of the upward axis, 0 to 2.
        room: Whether the mesh is a room, whose walls are hidden when seen from outside.
    """

    title: str
    panels: tuple[str, ...]
    views: tuple[str, ...] = ("light",)
    sliders: tuple[Slider, ...] = ()
    flat: bool = False
    up: int = 1
    room: bool = False

    @abstractmethod
    def draw(self, canvas: Canvas, state: State) -> None:
        """Draws or updates the content of the panels."""

    @abstractmethod
    def caption(self, state: State) -> str:
        """One line about the content."""

    def box(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lowest and highest corner of the region that the first camera shows; None for everything that is drawn."""
        return None
