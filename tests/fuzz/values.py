"""Values that no number, name or list of an input should have, as hypothesis draws them."""

from __future__ import annotations

from hypothesis import strategies as st

DEEP = 3000  # levels of nesting: more than Python's own limit
LONG = 5000  # digits: more than Python turns into an integer


def nested(levels: int, mark: str = "[]") -> str:
    """Text of lists within lists."""
    return mark[0] * levels + mark[1] * levels


# cells of a table and values of a header, as text
NOT_FINITE = ("nan", "NaN", "inf", "-inf", "1e400", "-1e999")
NO_NUMBER = ("abc", "--", "1,5", "1.2.3", "0x1F", "1e", "'", '"', "\\N", "12:34:56", "é", "true")
ODD = ("0", "-1", "-0.0", "1e300", "-1e300", "1e-320", "2147483648", "9" * 25, "9" * LONG)

not_finite = st.sampled_from(NOT_FINITE)
no_number = st.sampled_from(NO_NUMBER)
odd = st.one_of(st.sampled_from(ODD), st.integers().map(str), st.floats().map(repr))

plain = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from([0, -1, 1, 2**31, 2**63, 10**30, 1e308, -1e308, 5e-324, 0.5]),
    st.sampled_from([float("nan"), float("inf"), float("-inf")]),
    st.sampled_from(["", "abc", "nan", "..", "/dev/null", "\0", "é", "1", "x" * 5000]),
    st.text(max_size=8).filter(lambda text: text.isprintable()),
    st.floats(),
)
trees = st.recursive(
    plain,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.sampled_from(["a", "x", "name"]), inner)
    ),
    max_leaves=5,
)
