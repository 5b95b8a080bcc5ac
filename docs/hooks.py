"""Adds what the plugins do not: pages of notebooks and results, links to the reference, formulas as MathML."""

import base64
import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
STUB = (ROOT / "dqn_keras" / "__init__.pyi").read_text()
PUBLIC = {
    name: f"dqn_keras.{module}.{name}" for module, name in re.findall(r"from \.([\w.]+) import ([a-zA-Z]\w*)", STUB)
}
MENTION = re.compile(
    r"^(?P<ticks>`{3,}).*?^(?P=ticks)$"  # a code block: left as it is, like the next two
    r"|^#+ .*?$|^<summary>.*?$"
    r"|\[[^\]]*\](?:\([^)]*\)|\[(?P<target>[^\]]*)\])"  # a link; it counts as a mention
    rf"|`(?P<name>{'|'.join(PUBLIC)})(?:[(\[][^`]*)?`",  # a public name, perhaps with arguments
    re.DOTALL | re.MULTILINE,
)
ALT_TEXTS = {  # of the pictures in the notebooks, by the tag of their cell
    "save-rewards": "Episode rewards of one run: 20 and less for 170 episodes, then a climb to over 225",
    "save-pole": "The moving picture of one greedy episode: the network keeps the pole upright",
    "save-hundred_seeds": "A hundred seeds: learning curves, episodes to solved, share solved by episode",
    "save-slow_target": "Share not solved by episode 500, median episodes and greedy return for four values of tau",
    "save-catch_run": "A run at a glance: rewards, Q-values under their bound, TD error, terminal share",
    "save-catch": "The moving picture of an episode: the paddle catches ball after ball",
    "picture-table": "The lake after 0 to 1,000 episodes: values spread from the goal to the start, arrows lead there",
    "picture-wrong_states": "What Q says against what is measured: closer for states met in training than at random",
    "save-does_it_need_this": "Share not solved by episode 500, median episodes and greedy return for nine settings",
    "save-one_collapse": "One seed that got stuck: reward, greedy return, highest Q, share of terminal transitions",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the results and the notebooks, from where they are in the repository."""
    for path in sorted(ROOT.glob("results/**/*.*")):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    for path in sorted(ROOT.glob("notebooks/*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.name}", abs_src_path=str(path)))
        pictures: dict[str, bytes] = {}
        page = "\n\n".join(notebook_blocks(path, pictures))
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=page))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def notebook_blocks(path: Path, pictures: dict[str, bytes]) -> Iterator[str]:
    """Yields a notebook and its committed outputs as Markdown, without running it. Adds its pictures to `pictures`."""
    heading = ""
    cells = nbformat.read(path, as_version=4).cells
    kind = "A notebook, with its outputs" if any(cell.get("outputs") for cell in cells) else "A notebook to work in"
    for cell in cells:
        if cell.cell_type == "markdown":
            yield re.sub(r"\((\w+)\.ipynb", r"(\1.md", cell.source)  # links lead from page to page
            for line in re.findall(r"^#+ (.*)", cell.source, re.MULTILINE):
                if not heading:
                    yield f"*{kind}: [{path.name}]({path.name}).*{{ .source }}"
                heading = line
            continue
        code = fence(cell.source, "python")
        is_folded = "folded" in cell.metadata.get("tags", [])
        yield f'<details markdown="1"><summary>Show the code</summary>\n\n{code}\n\n</details>' if is_folded else code
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                tags = [tag for tag in cell.metadata.get("tags", []) if tag in ALT_TEXTS]
                mark = "{ .moving }" if b"acTL" in pictures[name][:200] else ""
                yield f"![{ALT_TEXTS[tags[0]] if tags else 'Picture: ' + heading}]({name}){mark}"
            elif "text/markdown" in data:
                yield data["text/markdown"]
            else:
                yield fence(output.get("text") or data["text/plain"], "text", "output")


def fence(content: str, *classes: str) -> str:
    """Returns a code block, fenced by four backticks because the code may contain three."""
    return f"````{{{' '.join('.' + name for name in classes)}}}\n{content.rstrip()}\n````"


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Links the first mention of each public name to the reference. Lets the search show how-tos first."""
    if page.url.startswith("how_to/") and not page.is_index:
        page.meta["search"] = {"boost": 2}
    return markdown if page.url.startswith("reference/") else link_public_names(markdown)


def link_public_names(markdown: str) -> str:
    """Returns the page with links; code, headings and existing links stay as they are."""
    linked = set()

    def link(mention: re.Match) -> str:
        target = mention["target"] or PUBLIC.get(mention["name"])
        if mention["name"] is None or target in linked:
            linked.add(target)
            return mention[0]
        linked.add(target)
        return f"[{mention[0]}][{target}]"

    return MENTION.sub(link, markdown)


def on_page_content(content: str, **_: Any) -> str:
    r"""Replaces the formulas, which arithmatex marks as \(...\) or \[...\], by MathML, which needs no script."""
    content = content.replace(  # the search finds names, not lines of source code
        '<details class="mkdocstrings-source">', '<details class="mkdocstrings-source" data-search-exclude>'
    )
    content = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', inline, content, flags=re.DOTALL)
    return re.sub(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', block, content, flags=re.DOTALL)


def inline(found: re.Match) -> str:
    """Returns a formula within a line."""
    return mathml(found[1], "inline")


def block(found: re.Match) -> str:
    """Returns a formula on a separate line; it scrolls on a narrow page."""
    return f'<div class="formula" tabindex="0">{mathml(found[1], "block")}</div>'


def mathml(latex: str, display: str) -> str:
    """Returns LaTeX as MathML, corrected where browsers would show it badly."""
    markup = convert(html.unescape(latex).strip(), display=display)
    for pattern, better in REPAIRS:
        markup = re.sub(pattern, better, markup)
    return markup


REPAIRS = [
    ("<mo>&#x0005E;</mo>", "<mo>&#x002C6;</mo>"),  # a hat: the accent, not the character of programs
    ("<mi>&#x0003B;</mi>", "<mo>&#x0003B;</mo>"),  # a semicolon has a space after it
    (r"<msup>(<mi>\w</mi>)<mi>(&#x02032;)</mi></msup>", r"<mrow>\1<mo>\2</mo></mrow>"),  # a prime is raised as it is
    (r"<msup>(<mo stretchy[^>]*>[^<]*</mo>)", r"<msup><mrow>\1</mrow>"),  # a parenthesis takes its size only in a row
]
