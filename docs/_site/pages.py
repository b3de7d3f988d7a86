"""Pages of the site that are made from the repository: one a config group, one a subpackage, the results."""

import ast
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
PACKAGE = "memcomp_lightning"

# What the commands are made of, which nobody imports.
INTERNAL = ("cli", "conf")

# Titles of results, in the order of the README; other experiments follow under their own headings.
TITLES = {
    "defaults": "Default settings",
    "figure2": "Figure 2",
    "figure4": "Figure 4",
    "figure5": "Figure 5",
    "figure6": "Figure 6",
    "readings": "Other readings",
    "annealer": "An annealer",
    "sampler_worth": "What a sampler is worth",
    "likelihood": "Log-likelihoods",
    "joint_pretraining": "Joint pretraining",
    "solver_benchmark": "Solver benchmark",
    "dmm_study": "Parts of the DMM",
    "throughput": "Throughput",
    "from_scikit_learn": "Beside scikit-learn",
}
MADE_BY_RUNS = {"results", "cache"}
SHOWN = (".md", ".png", ".svg", ".csv", ".json")

# Pages of the repository outside docs that others link to.
TOP_PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "tests/downstream/README.md": "downstream.md",
}

LAST = [{"Changelog": "changelog.md"}, {"Contributing": "contributing.md"}, {"Security": "security.md"}]
"""Pages at the end of the menu."""

GROUP_TEXTS = {
    "callbacks": "What is looked at while training runs; [all callbacks](../callbacks.md).",
    "control": "What a single run does instead, to see what an effect is due to.",
    "data": "Images, their partitions, batches and held-out share.",
    "data/training": "How energy models of a kind of data are trained; the data choose it.",
    "density": "A comparison of density models; `experiment=density` chooses it.",
    "experiment": "Named combinations of settings: figures, comparisons.",
    "figure": "Curves, sizes and claims of a figure; the experiments of that name choose them.",
    "figure/curves": "Curves that a figure adds to its own.",
    "few_labels": "A study of few labels; `experiment=few_labels` chooses it.",
    "finetune": "Back-propagation after pretraining.",
    "hparams": "Searches for good settings, a multirun; [sweeps](../sweeps.md).",
    "logger": "Where numbers and pictures go.",
    "model": "The network.",
    "positive": "What supplies the hidden units given the data where they are coupled to each other.",
    "preset": "Settings of all groups at once: those of the paper, or those of a figure in a minute or two.",
    "preset/figure": "What a preset does to a figure.",
    "preset/study": "What a preset does to an experiment that is no figure.",
    "pretrain": "Pretraining: rate, updates, which layers at once.",
    "sampler": "What supplies the negative phase; [where each one sits](../concepts.md).",
    "solver": "What looks for ground states of the QUBO, of the samplers that need one and of `memcomp-solve`.",
    "solver/field": "The equations of the DMM; [the DMM](../dmm.md).",
    "trainer": "Lightning's trainer.",
    "updown": "Training of the pretrained network as a generative model.",
    "units": "What the visible units are, and how grey values become their values; [units](../units.md).",
    "worth": "Comparisons by likelihood; the experiments of that name choose them.",
}


class Option(NamedTuple):
    """One file of a group."""

    name: str
    text: str
    yaml: str
    target: str | None


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the generated pages into the navigation."""
    settings = ["config/index.md", *({group: f"config/{slug(group)}.md"} for group in groups())]
    api = ["api/index.md", *({name: f"api/{name}.md"} for name in api_modules())]
    measured = [
        "experiments/index.md",
        *({title: f"experiments/{name}/README.md"} for name, title in results().items()),
    ]
    nav = [*(config.nav or [])]
    nav[2:2] = [{"Configuration": settings}, {"Results": measured}]
    config.nav = [*nav, {"API": api}, *LAST]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and what the results show."""
    pages = {
        "config/index.md": settings_page(),
        **{f"config/{slug(group)}.md": group_page(group) for group in groups()},
        "api/index.md": api_index(),
        **{f"api/{name}.md": api_page(name) for name in api_modules()},
        "experiments/index.md": results_page(),
    }
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    for path in [ROOT / name for name in TOP_PAGES] + experiment_files():
        source = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, in_site(source), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links that lead through the repository, and put pictures of the site's own into the page."""
    site = page.file.src_uri
    source = in_repository(site)

    def rewritten(match: re.Match[str]) -> str:
        target, hash_, anchor = match[1].partition("#")
        if not target or "://" in target or target.startswith(("mailto:", "/")):
            return match[0]
        there = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        return f"]({posixpath.relpath(in_site(there), posixpath.dirname(site) or '.')}{hash_}{anchor})"

    if (ROOT / source).exists():
        markdown = re.sub(r"\]\(([^)\s]+)\)", rewritten, markdown)

    def inlined(match: re.Match[str]) -> str:
        # Inline it follows the colours of the page; as a picture on GitHub it follows those of the system.
        svg = (ROOT / "docs" / match[2]).read_text()
        return f'<div class="flow" role="img" aria-label="{match[1]}">{svg}</div>'

    return re.sub(r"!\[([^\]]*)\]\((flow\.svg)\)", inlined, markdown)


def in_site(source: str) -> str:
    """Return where a file of the repository lies in the site."""
    top, _, rest = source.partition("/")
    # Folders, which GitHub shows as they are, stand for the pages made from them.
    if top == "conf":
        return f"config/{slug(rest) or 'index'}.md"
    if top == PACKAGE:
        return f"api/{rest.partition('/')[0].removesuffix('.py') or 'index'}.md"
    if source == "experiments":
        return "experiments/index.md"
    return TOP_PAGES.get(source, source.removeprefix("docs/"))


def in_repository(site: str) -> str:
    """Inverse of :func:`in_site`; generated pages, which lie nowhere, stay where they are."""
    by_site = {there: here for here, there in TOP_PAGES.items()}
    if site in by_site:
        return by_site[site]
    if site.startswith("experiments/") and (ROOT / site).exists():
        return site
    return f"docs/{site}" if (ROOT / "docs" / site).exists() else site


def slug(group: str) -> str:
    """Return the name of a group's page."""
    return group.replace("/", "-")


# Settings


def groups() -> list[str]:
    """Return the folders of ``conf``, nested ones as ``solver/field``."""
    folders = {path.parent.relative_to(ROOT / "conf").as_posix() for path in (ROOT / "conf").rglob("*.yaml")}
    return sorted(folders - {"."})


def options(group: str) -> list[Option]:
    """Return the files of a group."""
    return [option(path) for path in sorted((ROOT / "conf" / group).glob("*.yaml"))]


def option(path: Path) -> Option:
    """Read a file: its leading comment is what it says about itself."""
    text = path.read_text()
    target = re.search(rf"^_target_: ({PACKAGE}\.[\w.]+)$", text, flags=re.MULTILINE)
    return Option(path.stem, " ".join(leading_comment(text)), text, target[1] if target else None)


def leading_comment(text: str) -> Iterator[str]:
    """Yield the lines of the comment that a file begins with."""
    for line in text.splitlines():
        if line.startswith("# @package"):
            continue
        if not line.startswith("#"):
            return
        yield line.removeprefix("#").strip()


def defaults() -> dict[str, str | None]:
    """Return the option that ``conf/config.yaml`` names for each group; of nested ones what their parents name."""
    chosen: dict[str, str | None] = {}
    for entry in yaml.safe_load((ROOT / "conf/config.yaml").read_text())["defaults"]:
        if isinstance(entry, dict):
            chosen.update(entry)
    for group in groups():
        parent, _, name = group.rpartition("/")
        parent_option = chosen.get(parent)
        if parent and parent_option:
            text = (ROOT / "conf" / parent / f"{parent_option}.yaml").read_text()
            entries = (yaml.safe_load(text) or {}).get("defaults", [])
            chosen[group] = next(
                (entry[name] for entry in entries if isinstance(entry, dict) and name in entry), None
            )
    return chosen


def settings_page() -> str:
    """Return the page of all groups, with the file they start from."""
    chosen = defaults()
    rows = [
        f"| [{group}]({slug(group)}.md) | {default_text(group, chosen)} | "
        f"{len(options(group))} | {GROUP_TEXTS.get(group, '')} |"
        for group in groups()
    ]
    parts = [
        "# Configuration",
        "A run is composed of one option a group. `GROUP=OPTION` on the command line swaps an option, "
        "`GROUP.NAME=VALUE` changes a setting, and `memcomp-train --help` shows both for the groups chosen:",
        "```sh\nmemcomp-train sampler=pcd sampler.k=5 pretrain.iterations=20\n```",
        "| group | default | options | what it chooses |\n| --- | --- | --- | --- |\n" + "\n".join(rows),
        "## memcomp-train {#memcomp-train}",
        "Settings outside the groups, from `conf/config.yaml`:",
        fenced((ROOT / "conf/config.yaml").read_text().partition("\nhydra:")[0]),
        "## memcomp-solve {#memcomp-solve}",
        "From `conf/solve.yaml`; `memcomp-solve --help` describes the formats. Its other settings are those of "
        "the group [solver](solver.md).",
        fenced((ROOT / "conf/solve.yaml").read_text().partition("\nhydra:")[0]),
    ]
    return "\n\n".join(parts) + "\n"


def default_text(group: str, chosen: dict[str, str | None]) -> str:
    """Return the default of a group, in words where there is none."""
    return f"`{chosen[group]}`" if chosen.get(group) else "not chosen"


def group_page(group: str) -> str:
    """Return the page of one group."""
    chosen = defaults()
    parts = [
        f"# {group}",
        GROUP_TEXTS.get(group, ""),
        f"Default: {default_text(group, chosen)}.",
        "| option | |\n| --- | --- |",
    ]
    for item in options(group):
        parts[-1] += f"\n| [`{item.name}`](#{item.name}) | {item.text.replace('|', chr(92) + '|')} |"
    for item in options(group):
        mark = " (default)" if chosen.get(group) == item.name else ""
        parts += [f"## {item.name}{mark} {{#{item.name}}}", item.text]
        parts += [f"On the command line {typed(group, item.name)}" + class_text(item) + ":", fenced(item.yaml)]
    return "\n\n".join(parts) + "\n"


SET_BY = {
    "figure": "an `experiment` sets it: `experiment={option}`",
    "figure/curves": "`figure/curves={option}`, beside an `experiment` that is a figure",
    "worth": "an `experiment` sets it: `experiment=sampler_worth` or `experiment=joint_likelihood`",
    "preset/figure": "`preset={option}`, beside an `experiment` that is a figure",
    "preset/study": "by an experiment and a preset: `experiment=few_labels preset=quick`",
    "density": "an `experiment` sets it: `experiment={option}`",
    "data/training": "by the data: `data={option}`",
    "few_labels": "an `experiment` sets it: `experiment={option}`",
    "hparams": "`-m hparams={option}`",
}
"""Groups that are not chosen by their name alone."""


def typed(group: str, option: str) -> str:
    """How an option is chosen."""
    return SET_BY.get(group, f"`{group}={{option}}`").format(option=option)


def class_text(item: Option) -> str:
    """Return a link to the page of the class that an option builds."""
    if item.target is None:
        return ""
    module, _, name = item.target.removeprefix(f"{PACKAGE}.").partition(".")
    path = dict(public_names(module)).get(name, item.target)
    return f", which builds [`{name.rpartition('.')[2]}`][{path}]"


def fenced(text: str) -> str:
    """Return text as a block of YAML."""
    return f"```yaml\n{text.rstrip()}\n```"


# API


def api_modules() -> list[str]:
    """Return subpackages and modules that have a page."""
    packages = sorted(path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py"))
    single = sorted(path.stem for path in (ROOT / PACKAGE).glob("*.py") if path.name != "__init__.py")
    return [name for name in packages if name not in INTERNAL] + single


def public_names(module: str) -> list[tuple[str, str]]:
    """Return what a page of the API documents first: each name and its full path.

    The names of ``__all__`` under the package, which is how they are imported; the public ones of a single module.
    """
    package = ROOT / PACKAGE / module / "__init__.py"
    if not package.exists():
        return [(name, f"{PACKAGE}.{module}.{name}") for name in defined(ROOT / PACKAGE / f"{module}.py")]
    names = exported(package)
    static = {
        alias.asname or alias.name
        for node in ast.parse(package.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    found = []
    for name in names:
        # Names that a package imports when they are asked for are found where they are defined.
        path = f"{PACKAGE}.{module}.{name}" if name in static else definition(module, name)
        found.append((name, path))
    return found


def exported(package: Path) -> list[str]:
    """Return ``__all__``, and what is imported on demand, without importing anything.

    A tuple of names may be unpacked into ``__all__``.
    """
    tuples: dict[str, list[str]] = {}
    on_demand: list[str] = []
    for node in ast.parse(package.read_text()).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            modules = [argument for argument in node.value.args if isinstance(argument, ast.Dict)]
            on_demand += [key.value for keys in modules for key in keys.keys if isinstance(key, ast.Constant)]
        if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple | ast.List):
            continue
        names: list[str] = []
        for item in node.value.elts:
            if isinstance(item, ast.Starred) and isinstance(item.value, ast.Name):
                names += tuples[item.value.id]
            elif isinstance(item, ast.Constant):
                names.append(str(item.value))
        if isinstance(node.targets[0], ast.Name):
            tuples[node.targets[0].id] = names
    return list(dict.fromkeys([*tuples["__all__"], *on_demand]))


def defined(path: Path) -> list[str]:
    """Return the public classes, functions and documented constants of a file."""
    names = []
    body = ast.parse(path.read_text()).body
    for node, following in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            if isinstance(target, ast.Name) and said:
                names.append(target.id)
    return [name for name in names if not name.startswith("_")]


def definition(module: str, name: str) -> str:
    """Return the full path of a name that some file of a subpackage defines."""
    for path in modules(module):
        if name in defined(path):
            return f"{dotted(path)}.{name}"
    raise LookupError(f"{PACKAGE}.{module} has no file that defines {name}")


def modules(module: str) -> list[Path]:
    """Return the files of a subpackage."""
    return sorted(path for path in (ROOT / PACKAGE / module).rglob("*.py") if path.name != "__init__.py")


def dotted(path: Path) -> str:
    """Return the name that a file is imported by."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def docstring(module: str) -> str:
    """Return what a subpackage or module says about itself."""
    path = ROOT / PACKAGE / module / "__init__.py"
    return (
        ast.get_docstring(ast.parse((path if path.exists() else path.parent.with_suffix(".py")).read_text())) or ""
    )


def api_index() -> str:
    """Return the page of all subpackages."""
    rows = [
        f"| [{PACKAGE}.{name}]({name}.md) | {docstring(name).splitlines()[0].replace(':mod:', '')} |"
        for name in api_modules()
    ]
    text = (
        "# API\n\nEvery public name, by the subpackage it is imported from. A page begins with what the "
        "subpackage exports; below stand the public names of its files, for those who build on them. "
        "Shapes are those of [Concepts](../concepts.md): `*replicas` are leading axes that may be left out. "
        "The commands are described under [Configuration](../config/index.md).\n\n"
    )
    return text + "| | |\n| --- | --- |\n" + "\n".join(rows) + "\n"


def api_page(module: str) -> str:
    """Return the page of one subpackage."""
    parts = [f"# {module}", f"::: {PACKAGE}.{module}\n" + indented("members: []", "show_root_heading: false")]
    exported_names = public_names(module)
    parts += [f"::: {path}" for _, path in exported_names]
    init = ROOT / PACKAGE / module / "__init__.py"
    if init.exists():
        # By where it is defined: two modules may have something of one name, of which one is exported.
        imports = [node for node in ast.walk(ast.parse(init.read_text())) if isinstance(node, ast.ImportFrom)]
        said = {(node.module, alias.name) for node in imports for alias in node.names}
        said |= {(path.rpartition(".")[0], name) for name, path in exported_names}
        for path in modules(module):
            further = [name for name in defined(path) if (dotted(path), name) not in said]
            if further:
                parts.append(f"## In `{path.relative_to(ROOT / PACKAGE).as_posix()}`")
                parts += [f"::: {dotted(path)}.{name}\n" + indented("heading_level: 3") for name in further]
    return "\n\n".join(parts) + "\n"


def indented(*lines: str) -> str:
    """Return options of one entry of the API."""
    return "    options:\n" + "\n".join(f"      {line}" for line in lines)


# Results


def results() -> dict[str, str]:
    """Return the title of each experiment that has a page."""
    found = {path.parent.name for path in (ROOT / "experiments").glob("*/README.md")}
    listed = {name: title for name, title in TITLES.items() if name in found}
    return listed | {name: heading(name) for name in sorted(found - listed.keys())}


def experiment_files() -> list[Path]:
    """Return pages, pictures and tables of the experiments."""
    return sorted(
        path
        for name in results()
        for path in (ROOT / "experiments" / name).rglob("*")
        if path.suffix in SHOWN and not MADE_BY_RUNS & set(path.relative_to(ROOT).parts)
    )


def results_page() -> str:
    """Return the page of all experiments: the claims of the README, a line for each experiment."""
    readme = (ROOT / "README.md").read_text()
    shown = readme.partition("## What it shows so far\n")[2].partition("\n## ")[0]
    shown = shown.replace("(experiments/", "(")
    rows = [f"| [{title}]({name}/README.md) | {heading(name)} |" for name, title in results().items()]
    listed = "## All experiments\n\n| | |\n| --- | --- |\n" + "\n".join(rows)
    return f"# Results\n{shown}\n\n{listed}\n"


def heading(name: str) -> str:
    """Return the title of an experiment's page."""
    return (ROOT / "experiments" / name / "README.md").read_text().partition("\n")[0].removeprefix("# ")
