"""Chooses the method and the number of Gaussians of a fit by error and bytes of GPU memory."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.parts import Part
from wlm.probe.data import ProbeSet
from wlm.probe.evaluation import at_hour, relative_figures
from wlm.probe.gaussian.model import gaussian_bytes, gaussian_count
from wlm.probe.model import ProbeModel, Profile
from wlm.probe.pca.fit import ENOUGH, fit_components

_REPEATED = 100  # number in the checkpoint of a fit that is repeated after a resume, since only its error was kept
_FITS = 7  # most fits of a search
_POWER = 0.5  # the error is about this power of the number of Gaussians, inverted, until two fits have shown it
_MARGIN = 1.05  # factor of a guess, so that it rather reaches the target
_TRIES, _LESS = 3, 0.9  # fits of components with a smaller error over the day, and a factor, so that one suffices
_NETWORK, _NARROWER = 0.5, 16  # most of the bytes that a network takes before its layers get narrower by so many units
_CLOSE = 1.1  # a search ends when the number that reaches is at most this factor above one that does not


class Candidates:
    """The models of one set, fitted when they are asked for, and the choice between them by error."""

    def __init__(
        self,
        make: Callable[..., ProbeModel],
        probes: ProbeSet,
        values: np.ndarray,
        profile: Profile,
        device: str,
        trained: Callable[..., ProbeModel],
        checkpoint: Checkpoint | None,
        regions: int,
    ) -> None:
        """Keeps the arguments.

        Args:
            make: Makes a model of a profile, a content and a `choice`.
            probes: The set.
            values: float32 [V, T D], the numbers of its live probes for principal components.
            profile, device: The settings, and where errors are measured.
            trained: Fits Gaussians with a profile; `number` is that of the fit in the checkpoint.
            checkpoint: Keeps the errors of finished fits of a search; None: nothing is kept.
            regions: Number of regions, each with a network.
        """
        self._make, self._probes, self._profile, self._device = make, probes, profile, device
        self._trained, self._checkpoint, self._values = trained, checkpoint, values
        self._live, self._hours, self._regions = len(values), max(len(probes.times), 1), regions
        self._models: dict[int, ProbeModel] = {}
        self._errors: dict[int, float] = {}

    def usual(self) -> ProbeModel:
        """Returns the model for a profile that names neither a target nor a number of bytes."""
        profile = self._profile
        if profile.method == "pca":
            return self._measured(self._fitted(None, ENOUGH, "principal components, as the profile asks")[0])[0]
        if profile.method == "auto" and self._regions > 1:
            return self._measured(self._trained(profile))[0]
        count = gaussian_count(profile.ratio, self._live)
        if profile.method == "auto":
            budget = self._bytes(count)
            model, error = self._components(budget, ENOUGH)
            size = model.content.nbytes
            if size <= budget and error <= ENOUGH:
                took = f"{model.content.count} have an error of {error:.1%} of each probe's light in {size:,} bytes"
                model, _ = self._measured(model)
                return replace(model, choice=f"principal components: {took} of GPU memory; Gaussians take {budget:,}")
        gaussians, error = self._measured(self._trained(profile))
        if profile.method != "auto":
            return gaussians
        most = gaussians.content.nbytes
        told = f"Gaussians have an error of {error:.1%} of each probe's light in {most:,} bytes of GPU memory"
        rival = model if size <= most else self._components(most, ENOUGH)[0]
        if rival.content.nbytes > most:
            return replace(gaussians, choice=f"{told}, less than one principal component takes")
        rival, possible = self._measured(rival)
        if possible < error:
            return replace(rival, choice=f"principal components: {possible:.1%} in no more bytes; {told}")
        return replace(gaussians, choice=f"{told}; principal components of that size {possible:.1%}")

    def selected(self) -> ProbeModel:
        """Returns the smallest model found that reaches the target, or the most exact one within the bytes."""
        profile, name = self._profile, self._probes.name
        target, limit = profile.target or 0.0, profile.max_bytes or math.inf
        found: list[tuple[float, int, str, ProbeModel]] = []  # error, bytes, a sentence, the model
        most = limit
        if profile.method != "gaussians":
            model, error = self._measured(self._components(profile.max_bytes, target)[0])
            size = model.content.nbytes
            if size <= limit:
                told = f"{model.content.count} components have an error of {error:.1%} in {size:,}"
                found.append((error, size, told, model))
            if error <= target:
                most = min(most, size - 1)  # more Gaussians than that would be no gain
        if profile.method != "pca":
            self._narrow(limit)
            each, fixed = self._bytes(1) - self._bytes(0), self._bytes(0)
            count = int(min(most, self._bytes(self._live)) - fixed) // each
            count = count if count >= self._regions else 0
            if count and target:
                first = gaussian_count(profile.ratio, self._live)
                count = least_count(self._error, first, count, target) or count
            if count:
                error, model = self._error(count), self._gaussians(count)
                size = model.content.nbytes
                told = f"{model.content.count} Gaussians have an error of {error:.1%} in {size:,}"
                found.append((error, size, told, model))
        if not found:
            raise WlmError(f"{name}: max_bytes: expected more bytes, as no model of {self._live} probes fits {limit:,}")
        reached = [each for each in found if each[0] <= target]
        _, _, _, model = min(reached, key=lambda each: each[1]) if reached else min(found, key=lambda each: each[0])
        told = "; ".join(sentence for *_, sentence, _ in found)
        kind = "principal components" if model.method == "pca" else "Gaussians"
        warnings = model.warnings
        if target and not reached:
            least = min(error for error, *_ in found)
            missed = f"{name}: target: the {profile.error} error is {least:.1%}, more than the {target:.1%} asked for"
            warnings = (missed, *warnings)
        return replace(model, choice=f"{kind}: {told} bytes of GPU memory", warnings=warnings)

    def _narrow(self, limit: float) -> None:
        """Makes the network narrower until it leaves enough of the bytes to Gaussians."""
        while self._bytes(0) > _NETWORK * limit and self._profile.hidden > _NARROWER:
            hidden = (self._profile.hidden - 1) // _NARROWER * _NARROWER
            self._profile = self._profile.model_copy(update={"hidden": hidden})

    def _components(self, most: int | None, enough: float) -> tuple[ProbeModel, float]:
        """Returns the fewest principal components found with an error of at most `enough`, over all hours relative to
        the light of each hour, or as many as fit `most` bytes; and their error."""
        model, fitted = self._fitted(most, enough)
        if self._hours == 1:
            return model, fitted
        error, day = self._measured(model)[1], enough
        for _ in range(_TRIES):
            if error <= enough or fitted > day:
                break
            day *= _LESS * enough / error  # a dark hour needs a smaller error of the day
            model, fitted = self._fitted(most, day)
            error = self._measured(model)[1]
        return model, error

    def _fitted(self, most: int | None, enough: float, choice: str = "") -> tuple[ProbeModel, float]:
        """Returns the fewest principal components whose error, relative to light over the day, is at most `enough`, or
        as many as fit `most` bytes; and their error before ambient light is clamped."""
        relative = self._profile.error == "relative"
        content, error = fit_components(self._values, most, self._hours, enough, relative=relative)
        profile = Profile(name=self._profile.name, method="pca")
        return self._make(profile=profile, content=content, choice=choice), error

    def _bytes(self, count: int) -> int:
        """Returns the bytes of GPU memory of `count` Gaussians."""
        profile = self._profile
        sizes = profile.latent, profile.hidden, profile.columns(self._probes.outputs), self._hours
        return gaussian_bytes(count, *sizes) + (self._regions - 1) * gaussian_bytes(0, *sizes)

    def _error(self, count: int) -> float:
        """Returns the error of a fit of `count` Gaussians; a checkpoint keeps it."""
        if count not in self._errors:
            number, kept = len(self._errors), self._checkpoint
            stored = kept and kept.finished(number, {"error": Part(np.float64, (1,), least=0.0)})
            if stored:
                self._errors[count] = float(stored["error"][0])
            else:
                self._gaussians(count, number)
                error = self._errors[count]
                if kept is not None:
                    kept.add_finished(number, {"error": np.array([error])})
        return self._errors[count]

    def _gaussians(self, count: int, number: int = _REPEATED) -> ProbeModel:
        if count not in self._models:
            sized = {"ratio": count / self._live, "target": None, "max_bytes": None}
            model = self._trained(self._profile.model_copy(update=sized), number=number)
            self._models[count], self._errors[count] = self._measured(model)
        return self._models[count]

    def _measured(self, model: ProbeModel) -> tuple[ProbeModel, float]:
        """Returns the model with its warnings, and its error, the root mean square over all hours: of the live probes'
        relative errors, or of their errors as a share of the root mean square light of the hour."""
        decoder, live = model.decoder(self._device, position=self._probes.position), self._probes.live
        warnings, squares = [], []
        for time in self._probes.times.tolist() or [None]:
            decoder.set_time(time or 0.0)
            decoded, probes = decoder.decode_probes(), self._probes.at(time)
            figures = relative_figures(decoded, probes)
            warnings += [at_hour(time) + line for line in figures["warnings"]]
            error = figures["relative_error"]
            if self._profile.error == "absolute":
                values = probes.values[live].astype(np.float64)
                error = np.linalg.norm(decoded[live] - values) / (np.linalg.norm(values) or math.nan)
            squares.append(error**2)
        return replace(model, warnings=tuple(warnings)), math.sqrt(np.nanmean(squares))


def least_count(error_of: Callable[[int], float], first: int, most: int, target: float) -> int | None:
    """Searches the smallest number of Gaussians whose error is at most `target`.

    Args:
        error_of: Fits a number of Gaussians and returns their error, which falls like a power of the number.
        first, most: Number of the first fit, and the largest number, both at least 1.
        target: The error.

    Returns:
        The smallest number found, within a tenth if few fits suffice; None if `most` does not reach the target.
    """
    low, high, count, power = 0, 0, min(first, most), _POWER
    before: tuple[int, float] | None = None
    for _ in range(_FITS):
        error = error_of(count)
        low, high = (low, count) if error <= target else (max(low, count), high)
        if low >= most or (high and high <= max(low + 1, _CLOSE * low)):
            break
        if before is not None and (error - before[1]) * (count - before[0]) < 0:
            power = min(max(math.log(error / before[1]) / math.log(before[0] / count), 0.1), 2.0)
        before = count, error
        guess = _MARGIN * count * (error / target) ** (1.0 / power)
        upper = high - 1 if high else most
        count = int(min(max(guess, low + 1, low if high else 1.5 * low), upper))
    if not high and low < most and error_of(most) <= target:
        return most
    return high or None
