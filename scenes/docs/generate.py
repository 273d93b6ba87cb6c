"""Pages of the documentation site: those that stand beside the code, and references made from the code.

Run by `mkdocs build --strict` (mkdocs-gen-files), which writes nothing into the source tree.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jinja2
import matplotlib as mpl
import matplotlib.image
import mkdocs_gen_files
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent),
    autoescape=False,  # Markdown, of our own docstrings
    trim_blocks=True,
    undefined=jinja2.StrictUndefined,
)
PAGES = {
    "README.md": "index.md",
    "fastrod/README.md": "rod.md",
    "fastrod/GLOSSARY.md": "glossary.md",
    "fastrod/contact/README.md": "contact.md",
    "fastrod/identification/README.md": "identification.md",
    "fastrod/hosts/README.md": "embedding.md",
    "fastrod/generation/README.md": "data-sets.md",
    "gym_envs/README.md": "environments.md",
    "viewer/README.md": "viewer.md",
    "viewer/film.gif": "film.gif",
    "viewer/first_page.png": "first_page.png",
    "viewer/views.png": "views.png",
    "device/README.md": "prototype.md",
    "scenes/README.md": "scenes.md",
    "perf/README.md": "figures.md",
    "perf/COMPARISON.md": "comparison.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""A file in the source tree -> its place on the site."""
MADE = {
    "robot-file.md": "Robot file",
    "run-log.md": "Run log",
    "effects.md": "Effects",
    "commands.md": "Commands",
    "errors.md": "Errors and what to do",
    "citation.md": "Citation",
}
API = {
    "fastrod": "simulate, identify, read and write",
    "fastrod.contact": "obstacles",
    "fastrod.hosts": "rods in PyBullet, MuJoCo and engines of your own",
    "fastrod.control": "inverse kinematics, paths, arms with a soft tip",
    "fastrod.generation": "data sets",
    "fastrod.reference": "slow twins on scipy",
    "fastrod_envs": "environments",
    "fastrod_envs.sb3": "environments for stable-baselines3",
    "fastrod_scenes": "scenes",
}
"""Packages whose public names the reference lists, and what they are for."""
_FRAMES, _MOST_STEPS = 32, 96  # of a scene in motion
LAWS = ("Effect", "Law", "Static", "Operator", "BodyOperator", "Parameter", "Seam", "Signal", "effect")
"""Names of `fastrod.effects.base` of which an own effect is made."""
SECTIONS = {
    "Segment": ("[[segment]]", "fastrod.model.robot"),
    "Tendon": ("tendons of a segment", "fastrod.model.robot"),
    "Lump": ("lumps of a segment", "fastrod.model.robot"),
    "LogFormat": ("[log]", "fastrod.model.logformat"),
}
MATERIAL = {
    "youngs_modulus": "Young's modulus of a round segment of radius body_radius, for its stiffness [Pa]",
    "poisson": "with it, Poisson's ratio; left out: 0.3",
    "density": "with it, in place of line_density [kg/m^3]",
}
REMEDIES = {
    "RobotError": "Correct the key that it names; `fastrod new` writes a robot file that works.",
    "InputError": "Compare shape and unit with the sentence; `Simulator.step` lists the inputs.",
    "LogError": "Run `fastrod check LOG --robot R`: it names units, signs, order and clock.",
    "HostError": "Look the body or link up by the name that the engine gives it.",
    "EffectError": "Compare the effect's parameters with its page under Effects.",
    "SceneError": "A scene's own check failed: its sentence has the figure and its limit.",
    "DeviceError": "Follow its sentence: it names the drive, the object and what it reported.",
    "CalibrationError": "Take more pictures of the board, in the corners and at other angles.",
    "UnknownNameError": "Take the nearest name that it gives, or one of those it lists.",
}


def write(place: str, text: str) -> None:
    """One page of the site."""
    with mkdocs_gen_files.open(place, "w") as file:
        file.write(text)


def copied(source: str, place: str) -> None:
    """A page that stands beside the code, its links led to the site."""
    if not source.endswith(".md"):
        with mkdocs_gen_files.open(place, "wb") as picture:
            picture.write((ROOT / source).read_bytes())
        return

    def led(match: re.Match[str]) -> str:
        path, _, anchor = match[1].partition("#")
        if not path or path.startswith("http"):
            return match[0]
        target = ((ROOT / source).parent / path).resolve().relative_to(ROOT).as_posix()
        if target not in PAGES:
            raise ValueError(f"{source} links to {path}, which is no page of the site; add it to PAGES.")
        return f"]({PAGES[target]}{'#' if anchor else ''}{anchor})"

    write(place, re.sub(r"\]\(([^)\s]+)\)", led, (ROOT / source).read_text("utf-8")))


def rows(head: tuple[str, ...], body: list[tuple[str, ...]]) -> str:
    """A table."""
    lines = [head, tuple("---" for _ in head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def keys_of(kind: type) -> str:
    """The keys that the fields of a dataclass are in a robot file."""
    from fastrod_envs.describe import attribute_docs

    body, texts = [], attribute_docs(kind)
    for name, field in kind.__dataclass_fields__.items():  # type: ignore[attr-defined]
        text = texts.get(name, "")
        default = getattr(field, "default", None)
        plain = "" if "MISSING" in repr(default) else f"`{default!r}`"
        body.append((f"`{name}`", text, plain))
    if kind.__name__ == "Segment":
        body += [(f"`{name}`", text, "") for name, text in MATERIAL.items()]
    return rows(("key", "meaning", "default"), body)


def fill(template: str, place: str, **given: Any) -> None:
    """One page of the site, from a template beside this file."""
    write(place, TEMPLATES.get_template(f"{template}.md.j2").render(**given))


def robot_file() -> None:
    """Every key of a robot file."""
    from fastrod.commands.own import _robot_text
    from fastrod.identification.log.unknowns import MATERIAL as OF_ALL
    from fastrod.identification.log.unknowns import SEGMENT_UNITS, TENDON_UNITS
    from fastrod.model.robotfile import SENSOR

    given = {
        "segments": 1,
        "tendons": [3],
        "length": [100.0],
        "offset": [8.0],
        "angle": [0.0],
        "drive": "pull",
    }
    kinds = [
        (title, getattr(importlib.import_module(module), name)) for name, (title, module) in SECTIONS.items()
    ]
    targets = [(f'`"segment.*.{k}"`', unit) for k, unit in SEGMENT_UNITS.items()]
    targets += [(f'`"tendon.*.{k}"`', unit or "1") for k, unit in TENDON_UNITS.items()]
    targets += [('`"segment.1.lump.1.mass"`', "kg")]
    targets += [(f'`"material.{k}"`', "factor, or fraction") for k in OF_ALL]
    fill(
        "robot-file",
        "robot-file.md",
        example=_robot_text("mine", given).strip(),
        sections=[(title, first_of(kind), keys_of(kind)) for title, kind in kinds],
        sensor=rows(("key", "meaning"), [(f"`{k}`", v) for k, v in SENSOR.items()]),
        targets=rows(("target", "unit of sd"), targets),
    )


def first_of(kind: Any) -> str:
    """The first paragraph of a docstring."""
    return (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("\n", " ")


def run_log() -> None:
    """Every column of a run log, and how a file of one's own is translated."""
    from fastrod.model.logformat import COLUMNS, UNITS

    units = [(kind, ", ".join(f"`{u}`" for u in known)) for kind, known in UNITS.items()]
    columns = [(f"`{k}`", v) for k, v in COLUMNS.items()]
    tables = {"columns": rows(("column", "meaning"), columns), "units": rows(("kind", "units"), units)}
    fill("run-log", "run-log.md", **tables)


def effects() -> None:
    """A page for every effect: its law, its parameters, what shows it, and what it does to the tip."""
    from fastrod import load_robot
    from fastrod.effects.base import effect_names, get_effect, trait
    from fastrod.identification.report.wording import law, words
    from fastrod.model.routing import route

    listed, routing = [], route(load_robot("tdcr_b"))
    head = ("parameter", "unit", "without effect", "range", "one for each")
    for name in sorted(effect_names()):
        what = get_effect(name)
        listed.append((f"[{words(name)}](effects/{name}.md)", first_of(type(what)), what.seam.name.lower()))
        body = [
            (f"`{p.name}`", p.unit or "1", f"{p.neutral:g}", f"{p.bounds[0]:g} to {p.bounds[1]:g}", p.per)
            for p in what.parameters
        ]
        apart = trait(what, "separated_by")
        alike = [
            (f"[{words(k)}]({k}.md)", apart.get(k) or trait(get_effect(k), "separated_by").get(name, ""))
            for k in trait(what, "confounded_with")
        ]
        if picture := signature(name):
            write(f"effects/{name}.svg", picture)
        fill(
            "effect",
            f"effects/{name}.md",
            name=name,
            words=words(name),
            title=words(name).capitalize(),
            first=first_of(type(what)),
            law=law(name),
            typical=[p.on(routing) for p in what.parameters],
            parameters=rows(head, body),
            by_offset=any(p.of for p in what.parameters),
            excited_by=trait(what, "excited_by"),
            alike=rows(("alike in many logs", "run that separates them"), alike) if alike else "",
            synonyms=trait(what, "synonyms"),
            pictured=bool(picture),
        )
    about = "What a real robot does and an ideal model does not. `fastrod identify` tries each."
    write("effects.md", f"# Effects\n\n{about}\n\n{rows(('effect', '', 'seam'), listed)}")


def signature(name: str) -> str:
    """Return how an effect of typical size moves the tip while one bend swings to and fro, as SVG; empty
    where it does nothing then."""
    from fastrod import load_robot
    from fastrod.errors import FastrodError
    from fastrod.identification.log.unknowns import known_model
    from fastrod.identification.report import signature as found
    from fastrod.logs.runlog import RunLog
    from fastrod.model.routing import route

    robot = load_robot("tdcr_b")
    swing = 0.8 * np.sin(np.linspace(0.0, 12.0, 120))
    bend = np.zeros((120, robot.n_segments, 2))
    bend[:, :, 1] = swing[:, None]
    dl = route(robot).tendon_change(bend)
    log = RunLog(
        name="", t=np.linspace(0, 12, 120), run=np.full(120, ""), dl=dl, tip_position=np.zeros((120, 3))
    )
    try:
        model = known_model(robot).with_effect(name)
        state: Any = SimpleNamespace(model=model, theta=model.start)
        made = found.signatures(name, state, [], log)
    except FastrodError:
        return ""
    if not made or np.abs(made[0].shift).max() < 1e-6:
        return ""
    mpl.use("svg")
    import matplotlib.pyplot as plt

    with mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "fastrod", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(5.0, 2.8), layout="constrained")
        axes.plot(made[0].signal, 1e3 * made[0].shift, color="#3a6ea5", linewidth=1.4)
        axes.axhline(0.0, color="#999", linewidth=0.6)
        axes.set(xlabel=made[0].signal_label, ylabel=f"{made[0].shift_label} [mm]")
        axes.spines[["top", "right"]].set_visible(False)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None}, facecolor="white")
        plt.close(figure)
    return text.getvalue()


def commands() -> None:
    """Every command with its options."""
    from fastrod.commands.cli import build

    (group,) = [a for a in build()._actions if isinstance(a, argparse._SubParsersAction)]
    made = []
    for action in group._choices_actions:
        options = _options(command := group.choices[action.dest])
        for each in command._actions:
            if isinstance(each, argparse._SubParsersAction):
                for inner, parser in each.choices.items():
                    options += [(f"{inner} {flag}", what) for flag, what in _options(parser)]
        made.append((action.dest, (action.help or "").capitalize(), rows(("option", "meaning"), options)))
    fill("commands", "commands.md", commands=made)


def _options(command: argparse.ArgumentParser) -> list[tuple[str, str]]:
    made = []
    for action in command._actions:
        if action.dest == "help" or isinstance(action, argparse._SubParsersAction):
            continue
        name = ", ".join(action.option_strings) or str(action.metavar or action.dest)
        value = f" {action.metavar}" if action.option_strings and action.metavar else ""
        made.append((f"`{name}{value}`", action.help or ""))
    return made


def environments() -> None:
    """The table of all environments, below their page."""
    from fastrod_envs.describe import describe
    from fastrod_envs.registration import names

    text = [(ROOT / "gym_envs/README.md").read_text("utf-8"), "## Every environment"]
    for name in names():
        with mkdocs_gen_files.open(f"environments/{name}.png", "wb") as picture:
            picture.write(_pictured(name))
        page = describe(name, timed=False)
        text += [f"### {name}", f"![{name} some steps on](environments/{name}.png)"]
        text += ["```text", page, "```"]
    body = "\n\n".join(text).replace("```text\n\n", "```text\n").replace("\n\n```", "\n```")
    body = re.sub(r"\]\(\.\./([^)#\s]+)", lambda m: f"]({PAGES[m[1]]}", body)
    write("environments.md", body)


def _pictured(name: str) -> bytes:
    """PNG of an environment, some random steps into an episode."""
    env = gymnasium.make(f"fastrod/{name}-v0", render_mode="rgb_array")
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(5):
        if env.step(env.action_space.sample())[2]:
            env.reset(seed=1)
    out = io.BytesIO()
    mpl.image.imsave(out, env.render(), format="png")
    env.close()
    return out.getvalue()


def scenes() -> None:
    """A page in motion of each scene, below their page: the beginning of its script, to rotate and zoom."""
    from fastrod_scenes.scene import names
    from fastrod_viewer.drive.session import ViewFrame
    from fastrod_viewer.export import wrap
    from fastrod_viewer.page import PageView, plain, stand_back
    from fastrod_viewer.picture.canvas import Canvas
    from fastrod_viewer.picture.drawing import Drawing
    from fastrod_viewer.picture.options import ViewOptions
    from fastrod_viewer.server import serve
    from fastrod_viewer.worlds.catalogue import open_world

    served, text = serve(port=0), ["\n\n## Every scene in motion\n"]
    for name in names():
        world, canvas = open_world(name), Canvas(served.viser)
        drawing = Drawing(canvas, world, ViewOptions(body="skin"))
        stand_back(served.viser, PageView(drawing.middle, drawing.size))
        film = served.viser.get_scene_serializer()
        each = max(1, min(_MOST_STEPS, round(world.duration / world.dt)) // _FRAMES)
        for _ in range(_FRAMES):
            for _ in range(each):
                world.play()
            drawing.draw(ViewFrame(world, None, None, float("nan"), 1.0, ""))
            film.insert_sleep(each * world.dt)
        page = wrap(
            film.as_html(),
            title=plain(name),
            subtitle=world.about,
            legend_html=drawing.legend,
            plot_svg=None,
            facts=[("shown", f"{_FRAMES * each * world.dt:.1f} s of {world.duration:.1f} s")],
            note="Drag to rotate, scroll to zoom.",
        )
        write(f"films/{name}.html", page)
        text.append(f"- [{plain(name)}](films/{name}.html). {world.about}")
        canvas.clear()
        world.close()
    served.stop()
    with mkdocs_gen_files.open("scenes.md", "a") as file:
        file.write("\n".join(text) + "\n")


def api() -> None:
    """Every public name."""
    text = ["# API", "Names are imported from the package that heads their section."]
    for package, purpose in API.items():
        module = importlib.import_module(package)
        text += [f"## {package}: {purpose}"]
        for name in getattr(module, "__all__", None) or [
            n for n in vars(module) if n[0].islower() and _own(module, n)
        ]:
            thing = getattr(module, name)
            place = f"{package}.{name}" if inspect.ismodule(thing) else _place(thing, f"{package}.{name}")
            text += [f"::: {place}", "    options:", "      heading_level: 3", ""]
    text += ["## fastrod.effects.base: an effect of your own"]
    for name in LAWS:
        text += [f"::: fastrod.effects.base.{name}", "    options:", "      heading_level: 3", ""]
    write("api.md", "\n".join(text))


def _own(module: Any, name: str) -> bool:
    return getattr(vars(module)[name], "__module__", None) == module.__name__


def _place(thing: Any, name: str) -> str:
    module, qualified = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    return f"{module}.{qualified}" if module and qualified and module.startswith("fastrod") else name


def errors() -> None:
    """Every exception and problem, and what to do."""
    from fastrod import errors as every

    for module in ("fastrod_scenes.scene", "fastrod_device.errors"):
        importlib.import_module(module)
    kinds = [every.FastrodError, *every.FastrodError.__subclasses__()]
    body = [
        (f"`{k.__name__}`", inspect.getdoc(k).partition("\n")[0], REMEDIES.get(k.__name__, "")) for k in kinds
    ]
    problems = [
        (f"`{p.name}`", text) for p, text in zip(every.Problem, _after_members(every.Problem), strict=True)
    ]
    tables = {
        "kinds": rows(("error", "meaning", "what to do"), body),
        "problems": rows(("problem", "meaning"), problems),
    }
    fill("errors", "errors.md", **tables)


def _after_members(kind: type) -> list[str]:
    (body,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(body, ast.ClassDef)
    texts = [
        n.value.value for n in body.body if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)
    ]
    return [" ".join(str(text).split()) for text in texts[1:]]


def citation() -> None:
    """CITATION.cff as it is."""
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    write("citation.md", f"# Citation\n\n`CITATION.cff` in the source:\n\n```yaml\n{text}```\n")


for source, place in PAGES.items():
    copied(source, place)
for make in (robot_file, run_log, effects, commands, environments, scenes, api, errors, citation):
    make()
