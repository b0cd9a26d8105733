"""An extension of griffe, which reads docstrings: formulas as MathML, which browsers set by themselves."""

import re
from typing import Any

import latex2mathml.converter
from griffe import Extension, Object

_SPECIAL_IN_MARKDOWN = {ord(c): f"&#{ord(c)};" for c in "*_[]`"}


class Formulas(Extension):
    """``.. math::`` blocks and ``:math:`` roles in every docstring."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Rewrite its docstring."""
        if obj.docstring is not None and "math:" in obj.docstring.value:
            obj.docstring.value = formulas_as_mathml(obj.docstring.value)


def formulas_as_mathml(docstring: str) -> str:
    """Docstring with its formulas set.

    Raises:
        ValueError: If one has a command that is not known.
    """
    block = re.compile(r"^( *)\.\. math::(.*(?:\n(?:\1 +\S.*| *(?=\n)))*)", re.MULTILINE)
    text = block.sub(lambda m: f'{m[1]}<span class="formula">{mathml(m[2], "block")}</span>\n', docstring)
    return re.sub(r":math:`([^`]+)`", lambda m: mathml(m[1], "inline"), text)


def mathml(latex: str, display: str) -> str:
    """A formula as MathML, ``display`` inline or block.

    Raises:
        ValueError: If it has a command that is not known.
    """
    found = str(latex2mathml.converter.convert(" ".join(latex.split()), display=display))
    if "\\" in found:
        raise ValueError(f"formula has a command that latex2mathml does not know: {latex}")
    spaced = re.sub(r"(<mi>[a-z]{2,}</mi>)(?=<m[^o])", r'\1<mspace width="0.167em" />', found)  # log s, not logs
    return spaced.translate(_SPECIAL_IN_MARKDOWN)
