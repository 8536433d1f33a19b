"""Forms in which errors are drawn; a new error term uses one of them."""

from bayesdist.assess.terms.forms.functions import FunctionField, Functions
from bayesdist.assess.terms.forms.independent import Independent, Known, KnownField, NoiseField
from bayesdist.assess.terms.forms.polynomials import (
    PolynomialField,
    Polynomials,
    polynomial_errors,
)
from bayesdist.assess.terms.forms.rows import (
    GIVEN,
    LOCAL,
    MEASURED,
    PRODUCT,
    PUBLISHED,
    DrawnField,
    ErrorDraws,
    ErrorField,
    ErrorTerm,
    Image,
    Pool,
    Row,
)
from bayesdist.assess.terms.forms.together import Together, TogetherField

__all__ = [
    "GIVEN",
    "LOCAL",
    "MEASURED",
    "PRODUCT",
    "PUBLISHED",
    "DrawnField",
    "ErrorDraws",
    "ErrorField",
    "ErrorTerm",
    "FunctionField",
    "Functions",
    "Image",
    "Independent",
    "Known",
    "KnownField",
    "NoiseField",
    "PolynomialField",
    "Polynomials",
    "Pool",
    "Row",
    "Together",
    "TogetherField",
    "polynomial_errors",
]
