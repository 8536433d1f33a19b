"""Plots of a run by name: the namespace ``run.plot``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bayesdist.errors import InputError, require_known, required
from bayesdist.report import plots
from bayesdist.report.run import ReportedRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from numpy.typing import NDArray


__all__ = ["RunPlots"]

RESIDUAL_KINDS = ("position", "histogram", "magnitude", "x", "y", "colour", "epoch")
MAPS = ("posterior", "formal", "relative")


@dataclass(frozen=True, eq=False, repr=False)
class RunPlots:
    """Plots of a run. Each method draws into `ax`, or into a new figure, and returns the axes.

    Parameters
    ----------
    run : ReportedRun
        Run that was sampled; its artefacts are read when a plot needs them.
    """

    run: ReportedRun

    def __dir__(self) -> list[str]:
        """Names of the plots only, for completion in notebooks."""
        fields = set(self.__dataclass_fields__)
        return [n for n in object.__dir__(self) if n not in fields and not n.startswith("_")]

    def map(
        self,
        ax: Axes | None = None,
        *,
        chip: int | None = None,
        which: str = "posterior",
        kind: str = "contours",
        mas: bool = False,
        **options: Any,
    ) -> Axes:
        """Plot the uncertainty of the position over a chip.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
        chip : int, optional
            Number of the chip; the first one by default.
        which : str
            'posterior' with all errors that neighbouring stars share, 'formal' for those of least
            squares, or 'relative' for relative positions in a self-calibration.
        kind : str
            'contours' or 'crosses'; see `bayesdist.report.plots.plot_map`.
        mas : bool
            True to show pixels in mas.
        **options
            Passed to `bayesdist.report.plots.plot_map`.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the chip or kind is unknown, the run does not have the map, or ``mas=True`` and the
            size of a pixel is unknown.
        """
        require_known(which, MAPS, "map", where="which")
        of = {"posterior": "maps", "formal": "formal", "relative": "relative"}
        maps = getattr(self.run.evaluation, of[which])
        if not maps:
            raise InputError(
                "relative positions are only evaluated in a self-calibration",
                where="plot.map",
                do="plot the map 'posterior'",
            )
        selected_map = maps[self._index(chip)]
        options = {"name": self._name(chip)} | options
        return plots.plot_map(selected_map, ax, kind=kind, scale_mas=self._scale(mas), **options)

    def distortion(
        self,
        ax: Axes | None = None,
        *,
        chip: int | None = None,
        part: str = "no_constant",
        mas: bool = False,
        **options: Any,
    ) -> Axes:
        """Plot the distortion of a chip as vectors.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
        chip : int, optional
            Number of the chip; the first one by default.
        part : str
            'no_constant' for the distortion minus its value at the reference pixel, 'non_linear'
            for only the terms of order 2 and higher.
        mas : bool
            True to state lengths in mas.
        **options
            Passed to `bayesdist.report.plots.plot_distortion`.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the chip or part is unknown, or ``mas=True`` and the size of a pixel is unknown.
        """
        from bayesdist.assess.vectors import diagram_vectors

        chosen = self.run.fit.model.chips[self._index(chip)]
        epoch = self.run.evaluation.settings.epoch
        vectors = diagram_vectors(self.run.solution, chosen, part=part, epoch=epoch)
        options = {"name": self._name(chip)} | options
        return plots.plot_distortion(vectors, ax, scale_mas=self._scale(mas), **options)

    def residuals(
        self,
        ax: Axes | None = None,
        *,
        kind: str = "position",
        axis: str = "u",
        chip: int | None = None,
        **options: Any,
    ) -> Axes:
        """Plot the residuals, data minus model.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
        kind : str
            'position': mean residual of each cell of a chip as a vector. 'histogram': core of the
            residuals with the expected distribution (with ``tails=True`` all residuals).
            'magnitude': density of the residuals against magnitude. 'x', 'y', 'colour', 'epoch':
            means in bins of that quantity, with their errors.
        axis : str
            'u' or 'v'; the kind 'position' shows both.
        chip : int, optional
            Number of the chip of the kind 'position'; the first one by default.
        **options
            Passed to the function of `bayesdist.report.plots` that draws the kind.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the kind, axis or chip is unknown, or the stars do not have the quantity.
        """
        require_known(kind, RESIDUAL_KINDS, "kind of residuals", where="kind")
        run = self.run
        sample, unit, rows = run.diagnostics.sample, run.fit.model.unit, run.kind.words.rows
        if kind == "position":
            binned = run.diagnostics.shown[self._index(chip)].residuals()
            options = {"unit": unit, "name": self._name(chip)} | options
            return plots.plot_residual_vectors(binned, ax, **options)
        if kind == "histogram":
            of_run: dict[str, Any] = {"fit": run.fit, "posterior": run.posterior, "rows": rows}
            return plots.plot_residual_histogram(sample, ax, axis=axis, **of_run | options)
        if kind == "magnitude":
            options = {"unit": unit, "errors": run.errors.by_magnitude, "rows": rows} | options
            return plots.plot_residual_density(sample, ax, axis=axis, **options)
        solution = run.posterior
        return plots.plot_residual_means(sample, kind, ax, axis=axis, solution=solution, **options)

    def exposures(self, ax: Axes | None = None) -> Axes:
        """Plot the chi-square per degree of freedom of each exposure.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the run has only one exposure.
        """
        scatter = self.run.diagnostics.sample.by_exposure
        return plots.plot_exposures(required(scatter, "the run has one exposure"), ax)

    def budget(
        self,
        ax: Axes | None = None,
        *,
        chip: int | None = None,
        mas: bool = False,
        **options: Any,
    ) -> Axes:
        """Plot the terms of the error budget as bars, the total last.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
        chip : int, optional
            Number of the chip; all chips together by default.
        mas : bool
            True to show pixels in mas.
        **options
            Passed to `bayesdist.report.plots.plot_budget`.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the chip is unknown, or ``mas=True`` and the size of a pixel is unknown.
        """
        scale_mas = self._scale(mas)
        if chip is not None and self._several:
            name = self.run.fit.model.chips[self._index(chip)].name
            options = {"over": name or f"chip {chip}"} | options
        budget = self.run.evaluation.budget
        return plots.plot_budget(budget, ax, chip=chip, scale_mas=scale_mas, **options)

    def margins(self, ax: Axes | None = None) -> Axes:
        """Plot the requirements: the distribution of each statistic against its limit.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If no requirement was stated.
        """
        return plots.plot_margins(self.run.evaluation.margins, ax)

    def validity(self, ax: Axes | None = None, *, requirement: str | None = None) -> Axes:
        """Plot the probability of meeting a requirement against time.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
        requirement : str, optional
            Name of the requirement; the first one by default.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the requirement is unknown, or the solution does not depend on time.
        """
        periods = {period.requirement.name: period for period in self.run.evaluation.validity}
        if not periods:
            raise InputError(
                "the run has no validity period",
                where="plot.validity",
                do="state a requirement, and fit a model that depends on time",
            )
        name = next(iter(periods)) if requirement is None else requirement
        require_known(name, tuple(periods), "requirement", where="requirement")
        return plots.plot_validity(periods[name], ax)

    def corner(
        self, parameters: Sequence[str] | None = None, *, fig: Figure | SubFigure | None = None
    ) -> NDArray[Any]:
        """Plot the joint posterior of each pair of some parameters.

        Parameters
        ----------
        parameters : sequence of str, optional
            Names of coefficients, or 'f', 'j' and 's_out' of the outlier mixture; by default those
            of the mixture.
        fig : matplotlib.figure.Figure or SubFigure, optional
            Empty figure to draw into.

        Returns
        -------
        ndarray of matplotlib.axes.Axes, shape (n, n)
            Panels above the diagonal are None.

        Raises
        ------
        InputError
            If a parameter is unknown, or nothing was sampled.
        """
        return plots.plot_corner(self.run.posterior, parameters, fig=fig)

    def correlations(self, ax: Axes | None = None) -> Axes:
        """Plot the correlations between the coefficients in the posterior.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If nothing was sampled.
        """
        return plots.plot_correlations(self.run.posterior, ax)

    def ranks(self, ax: Axes | None = None, *, parameter: str | None = None) -> Axes:
        """Plot the ranks of the draws of each ensemble, which are flat if the ensembles agree.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
        parameter : str, optional
            By default the coefficient with the fewest effective draws.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If the parameter is unknown, or nothing was sampled.
        """
        return plots.plot_ranks(self.run.posterior, parameter, ax)

    def __repr__(self) -> str:
        """Names of the plots that this run has, with a description of each."""
        left_out: set[str] = set()
        if not self.run.evaluation.margins:
            left_out.add("margins")
        if not self.run.evaluation.validity:
            left_out.add("validity")
        if self.run.diagnostics.sample.by_exposure is None:
            left_out.add("exposures")
        lines = []
        for name, method in vars(RunPlots).items():
            if callable(method) and not name.startswith("_") and name not in left_out:
                what = (method.__doc__ or "").partition("\n")[0].removeprefix("Plot ")
                lines.append(f"  .{name + '()':<16}{what}")
        return "\n".join(["Plots of the run:", *lines])

    @property
    def _several(self) -> bool:
        return len(self.run.fit.model.chips) > 1

    def _index(self, chip: int | None) -> int:
        return 0 if chip is None else self.run.fit.model.chip_code(chip)

    def _name(self, chip: int | None) -> str:
        """Name of a chip for titles; empty if there is only one chip."""
        chosen = self.run.fit.model.chips[self._index(chip)]
        return (chosen.name or f"chip {chosen.number}") if self._several else ""

    def _scale(self, mas: bool) -> float | None:
        """Size of a pixel in mas if requested, else None."""
        if not mas:
            return None
        scale_mas = self.run.evaluation.settings.scale_mas
        if scale_mas is None and self.run.fit.model.unit == "pix":
            raise InputError(
                "the size of a pixel is unknown",
                where="plot",
                do="give the run its pixel scale (detector.scale_mas), or plot pixels",
            )
        return scale_mas
