"""What a window shows: panels, sliders and views, made by one class for each kind of file."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from wlm.view.canvas import Canvas, Hit
from wlm.view.display import TONES, Display


@dataclass(frozen=True)
class Slider:
    """A number that a user moves.

    Attributes:
        name: Shown beside it, and that of the command's option.
        low, high: Its ends.
        value: Where it begins.
        step: What a key moves it by.
        form: Of its value in text.
        unit: Behind its value in text.
        whole: Whether it has only whole values.
        wraps: Whether its end is its beginning again, as midnight is.
        clock: Whether it is in hours of a day, which its text also has as a clock shows them.
        views: The views in which it does something; empty: all.
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

    def text(self, value: float) -> str:
        """Its name and a value of it."""
        shown = f"{self.name} {value:{self.form}}{self.unit}"
        minutes = round(value * 60.0) % 1440
        return f"{shown} ({minutes // 60}:{minutes % 60:02})" if self.clock else shown

    def fit(self, value: float) -> float:
        """The nearest value that it may have."""
        if self.wraps and not self.low <= value <= self.high:
            value = self.low + (value - self.low) % (self.high - self.low)
        value = min(max(value, self.low), self.high)
        return float(round(value)) if self.whole else value


def frame_slider(count: int, views: tuple[str, ...] = ()) -> tuple[Slider, ...]:
    """A slider of so many frames, which users count from 1; none for one frame."""
    if count < 2:
        return ()
    return (Slider("frame", 1, count, 1, 1, ".0f", f" of {count}", whole=True, views=views),)


@dataclass
class State:
    """What a user has chosen.

    Attributes:
        values: Of the sliders, by name.
        view: One of the scene's views.
        tone: One of `wlm.view.display.TONES`.
        outside: Whether the walls of a room are drawn from outside too, where they hide it.
    """

    values: dict[str, float]
    view: str
    tone: str = TONES[0]
    outside: bool = False

    @property
    def frame(self) -> int:
        """The index of the frame; users count them from 1."""
        return int(self.values.get("frame", 1)) - 1

    def display(self, exposure: float) -> Display:
        """How light is shown; `exposure` is that of 0 EV."""
        return Display(exposure * 2.0 ** self.values.get("exposure", 0.0), self.tone, self.values.get("error", 1.0))


@dataclass
class Scene(ABC):
    """One file, as a window shows it.

    Attributes:
        title: Of the window.
        panels: A title for each picture, from left to right.
        views: What the first of them can show besides; the first view is the usual one.
        sliders: Its own; the window adds those of the exposure and of the error.
        plays: The slider that runs when the scene is played; None, or in views without it: the camera turns.
        flat: Whether it lies in a plane, which isn't turned.
        up: 0 to 2, the axis that points up.
        room: Whether its mesh is a room that hides what is lit unless one looks through its walls from outside.
    """

    title: str
    panels: tuple[str, ...]
    views: tuple[str, ...] = ("light",)
    sliders: tuple[Slider, ...] = ()
    plays: str | None = None
    flat: bool = False
    up: int = 1
    room: bool = False

    @abstractmethod
    def draw(self, canvas: Canvas, state: State) -> None:
        """Brings what the panels show up to date; the first call fills them."""

    @abstractmethod
    def caption(self, state: State) -> str:
        """A line on what is shown."""

    def box(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The lowest and highest corner of what the camera shall see at first; None: of all that is drawn."""
        return None

    def describe(self, hit: Hit, state: State) -> str:
        """A line on what lies under the cursor; empty: nothing to tell."""
        return ""
