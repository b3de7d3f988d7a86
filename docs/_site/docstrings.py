"""What docstrings hold besides Markdown, put into Markdown: roles, formulas, examples."""

import html
import io
import re

import griffe
from matplotlib import mathtext, rc_context

ROLE = re.compile(r":(class|func|meth|attr|data|mod):`(~?)([\w.]+)`")
EXAMPLE = re.compile(r"^>>> .*(?:\n(?!\s*$).*)*", flags=re.MULTILINE)
INLINE = re.compile(r":math:`([^`]+)`")
FORMULA = re.compile(r"^\.\. math::[ ]*(.*(?:\n[ ]+\S.*)*)", flags=re.MULTILINE)

# What mathtext spells otherwise, or does not know.
SPELLINGS = {r"\max": r"\mathrm{max}", r"\arg": r"\mathrm{arg\,}", "&": "", r"\qquad": r"\quad", r"\ge ": r"\geq "}
SPACE = r"\ "
LEFT_OUT = (
    r"<metadata>.*?</metadata>",
    r"<!--.*?-->",
    r"<defs>\s*<style.*?</style>\s*</defs>",
    r'<g id="patch_1">.*?</g>',
    r' id="(figure|text)_1"',
)
WORDS = re.compile(r"(?<![\\\w{])(exp|log|softplus|sign|KL)(?![\w}])")


class Docstrings(griffe.Extension):
    """Rewrites each docstring once, when its object has been read."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value, obj)


def markdown(text: str, obj: griffe.Object) -> str:
    """Return a docstring as Markdown."""
    text = FORMULA.sub(lambda match: displayed(match[1]), text)
    text = INLINE.sub(lambda match: picture(match[1], 12), text)
    text = ROLE.sub(lambda match: reference(match[2] == "~", match[3], obj), text)
    return EXAMPLE.sub(lambda match: f"```pycon\n{match[0]}\n```", text)


def reference(short: bool, name: str, obj: griffe.Object) -> str:
    """Return a link to what a role names, as seen from an object; to its own text where that has no page."""
    shown = name.rpartition(".")[2] if short else name
    path = name
    if not name.startswith("memcomp_lightning"):
        scope: griffe.Object | griffe.Alias | None = obj
        head, _, rest = name.partition(".")
        while scope is not None and head not in scope.members:
            scope = scope.parent
        if scope is not None:
            member = scope.members[head]
            found = member.target_path if isinstance(member, griffe.Alias) else member.path
            path = f"{found}.{rest}" if rest else found
    return f'<autoref identifier="{path}" optional><code>{html.escape(shown)}</code></autoref>'


def displayed(formula: str) -> str:
    """Return a formula on lines of its own."""
    lines = " ".join(formula.split()).split(r"\\")
    pictures = (picture(line.strip(), 13) for line in lines if line.strip())
    return '<div class="formula">' + "<br>".join(pictures) + "</div>"


def picture(formula: str, size: float) -> str:
    """Return a formula as inline SVG in the colour of the text around it; its source is the label.

    A formula drawn here needs no script in the reader's browser.
    """
    spelled = formula
    for ours, theirs in SPELLINGS.items():
        spelled = spelled.replace(ours, theirs)
    spelled = re.sub(r"\\text\{([^}]*)\}", lambda match: rf"\mathrm{{{match[1].replace(' ', SPACE)}}}", spelled)
    spelled = WORDS.sub(r"\\mathrm{\1}", spelled)
    stream = io.StringIO()
    with rc_context({"svg.hashsalt": "formula", "mathtext.fontset": "cm", "font.size": size}):
        depth = mathtext.math_to_image(f"${spelled}$", stream, dpi=72, format="svg")
    svg = stream.getvalue()
    # Its background, its names and its style sheet would be the page's.
    for pattern in LEFT_OUT:
        svg = re.sub(pattern, "", svg, flags=re.DOTALL)
    svg = " ".join(svg[svg.index("<svg") :].split()).replace("> <", "><")
    head = f'<svg class="math" role="img" aria-label="{html.escape(formula)}" '
    return svg.replace("<svg ", f'{head}style="vertical-align: -{depth:.1f}pt" ', 1)
