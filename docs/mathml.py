"""Extension of Python-Markdown: formulas become MathML, which browsers render without a script."""

import html
import re

from latex2mathml.converter import convert
from markdown import Extension, Markdown
from markdown.postprocessors import Postprocessor
from markdown.preprocessors import Preprocessor

FENCE = re.compile(r"^```math\n(.*?)\n```$", re.DOTALL | re.MULTILINE)
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


class MathPreprocessor(Preprocessor):
    """Writes GitHub's fences of formulas as pymdownx.arithmatex reads them."""

    def run(self, lines: list[str]) -> list[str]:
        return FENCE.sub(lambda found: f"$$\n{found[1]}\n$$", "\n".join(lines)).split("\n")


class MathmlPostprocessor(Postprocessor):
    """Replaces the formulas that pymdownx.arithmatex marks by MathML."""

    def run(self, text: str) -> str:
        render = lambda found: convert(html.unescape(found[2]), display="inline" if found[1] == "span" else "block")
        return FORMULA.sub(render, text)


class MathmlExtension(Extension):
    """Registers both: before fences are read, and after all other postprocessors."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.preprocessors.register(MathPreprocessor(md), "math", 40)
        md.postprocessors.register(MathmlPostprocessor(md), "mathml", -1)


def makeExtension() -> MathmlExtension:  # the name that Python-Markdown looks for
    return MathmlExtension()
