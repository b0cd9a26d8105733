"""An extension of griffe, which reads docstrings: formulas as MathML, which browsers set, and examples."""

import re
from typing import Any

import latex2mathml.converter
from griffe import Extension, Object

_BLOCK = re.compile(r"^( *)\.\. math::(.*(?:\n(?:\1 +\S.*| *(?=\n|$)))*)", re.MULTILINE)
_FENCED = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_EXAMPLE = re.compile(r"^Example:[ \t]*$", re.MULTILINE)
_SPECIAL_IN_MARKDOWN = {ord(c): f"&#{ord(c)};" for c in "*_[]`"}


class Formulas(Extension):
    """``.. math::`` blocks, ``:math:`` roles and ``Example:`` sections in every docstring."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Rewrite its docstring."""
        if obj.docstring is not None:
            text = _EXAMPLE.sub("Examples:", obj.docstring.value)  # the only name of this section that griffe knows
            obj.docstring.value = formulas_as_mathml(text) if "math:" in text else text


def formulas_as_mathml(docstring: str) -> str:
    """Docstring with its formulas set.

    Raises:
        ValueError: If one has a command that is not known.
    """
    text = _BLOCK.sub(lambda m: f'{m[1]}<span class="formula">{mathml(m[2], "block")}</span>\n', docstring)
    return re.sub(r":math:`([^`]+)`", lambda m: f"<span>{mathml(m[1], 'inline')}</span>", text)


def fenced_as_mathml(markdown: str) -> str:
    """A page with its ``math`` blocks, which GitHub shows too, set.

    Raises:
        ValueError: If one has a command that is not known.
    """
    return _FENCED.sub(lambda m: f'<span class="formula">{mathml(m[1], "block")}</span>\n', markdown)


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
