"""Public names and the modules that define them; each is imported on first use."""

from .catalogue.magnitude_errors import fit_by_magnitude as fit_by_magnitude
from .catalogue.star_covariance import (
    StarCovariance as StarCovariance,
    star_covariance as star_covariance,
)
from .catalogue.star_errors import StarErrors as StarErrors
from .convergence import (
    Convergence as Convergence,
    Limits as Limits,
)
from .equations.priors import GaussianPriors as GaussianPriors
from .exposures.alone import (
    ExposureSolutions as ExposureSolutions,
    fit_exposures as fit_exposures,
)
from .exposures.hierarchy import (
    HierarchicalFit as HierarchicalFit,
    fit_hierarchical as fit_hierarchical,
    held_in_reference as held_in_reference,
)
from .posterior.files import (
    posterior_datatree as posterior_datatree,
    load_fit as load_fit,
    load_posterior as load_posterior,
    save_fit as save_fit,
    save_posterior as save_posterior,
)
from .solution.linear import (
    LinearFit as LinearFit,
    Rejection as Rejection,
    build_model as build_model,
    fit_linear as fit_linear,
    residuals as residuals,
)
from .nodes import (
    TableFit as TableFit,
    TablePosterior as TablePosterior,
    binned_table as binned_table,
    field_table as field_table,
    fit_with_tables as fit_with_tables,
)
from .posterior import (
    Posterior as Posterior,
    SamplerInfo as SamplerInfo,
)
from .posterior.memberships import (
    Memberships as Memberships,
    memberships as memberships,
)
from .sampler.sample import sample as sample
from .solution.solution import (
    ReferenceGauge as ReferenceGauge,
    Solution as Solution,
    TransformedSolution as TransformedSolution,
)
from .stars.loading import load as load
from .stars.likelihood import OutlierMixture as OutlierMixture
from .stars.shards import (
    Compute as Compute,
    Shards as Shards,
)
from .solution.transforms import (
    LinearTerms as LinearTerms,
    linear_terms as linear_terms,
    lines as lines,
    reference_gauge as reference_gauge,
    segment as segment,
    without_frames as without_frames,
)
