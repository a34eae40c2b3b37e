"""A feedback law as an FMU (FMI 3.0, https://fmi-standard.org): inputs are states, outputs controls."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import tempfile
import zipfile
from importlib import resources
from pathlib import Path
from xml.sax.saxutils import quoteattr

from .errors import CostateError, InputError

#: Value references: of the time, the first input, the first output.
TIME, INPUTS = 0, 1


def _identifier(name: str) -> str:
    made = re.sub(r"\W", "_", name, flags=re.ASCII)
    return made if made[:1].isalpha() else f"law_{made}"


def description(identifier, title, token, inputs, outputs, starts) -> str:
    """``modelDescription.xml``; inputs and outputs are (name, unit, description)."""
    q = quoteattr
    units = sorted({unit for _, unit, _ in [*inputs, *outputs] if unit not in ("", "1")})
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="3.0" modelName={q(title)} instantiationToken="{token}" generationTool="costate">',
        f'  <ModelExchange modelIdentifier="{identifier}" canGetAndSetFMUState="true" canSerializeFMUState="true"/>',
        f'  <CoSimulation modelIdentifier="{identifier}" canGetAndSetFMUState="true" canSerializeFMUState="true" '
        'canHandleVariableCommunicationStepSize="true"/>',
    ]
    if units:
        lines += ["  <UnitDefinitions>", *(f"    <Unit name={q(u)}/>" for u in units), "  </UnitDefinitions>"]
    lines += [
        "  <ModelVariables>",
        f'    <Float64 name="time" valueReference="{TIME}" causality="independent" variability="continuous"/>',
    ]
    taken = {"time"}
    for k, (name, unit, words) in enumerate([*inputs, *outputs]):
        is_input = k < len(inputs)
        # A state may have the name of a control, or be the time.
        own = name if name not in taken else f"{name}_{'in' if is_input else 'out'}"
        taken.add(own)
        more = f' start="{starts[k]!r}"' if is_input else ""
        if unit in units:
            more += f" unit={q(unit)}"
        if words:
            more += f" description={q(words)}"
        causality = "input" if is_input else "output"
        lines.append(f'    <Float64 name={q(own)} valueReference="{INPUTS + k}" causality="{causality}"{more}/>')
    lines += ["  </ModelVariables>", "  <ModelStructure>"]
    depends = " ".join(str(INPUTS + k) for k in range(len(inputs)))
    for kind in ("Output", "InitialUnknown"):
        for k in range(len(outputs)):
            reference = INPUTS + len(inputs) + k
            lines.append(f'    <{kind} valueReference="{reference}" dependencies="{depends}"/>')
    lines += ["  </ModelStructure>", "</fmiModelDescription>", ""]
    return "\n".join(lines)


def write(path, name, title, header, call, inputs, outputs, starts, compiled) -> None:
    """Writes the FMU: description, C source, and the binary of this platform if it is wanted.

    ``call`` is C that sets ``u`` (controls) at ``x`` (states).
    """
    path = Path(path)
    if path.suffix.lower() != ".fmu":
        raise InputError(f"{path}: name a file .fmu")
    identifier = _identifier(name)
    token = "{" + hashlib.sha256(header.encode()).hexdigest()[:32] + "}"
    adapter = resources.files(__package__).joinpath("fmi3.c").read_text(encoding="utf-8")
    known = {
        "STATES": str(len(inputs)),
        "CONTROLS": str(len(outputs)),
        "TOKEN": token,
        "STARTS": ", ".join(repr(float(s)) for s in starts),
        "CALL": call,
    }
    for key, value in known.items():
        adapter = adapter.replace(f"@{key}@", value)
    build = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{identifier}">\n'
        '    <SourceFileSet language="C99">\n'
        '      <SourceFile name="fmi3.c"/>\n'
        "    </SourceFileSet>\n"
        "  </BuildConfiguration>\n"
        "</fmiBuildDescription>\n"
    )
    files = {
        "modelDescription.xml": description(identifier, title, token, inputs, outputs, starts),
        "sources/buildDescription.xml": build,
        "sources/law.h": header,
        "sources/fmi3.c": adapter,
    }
    binary = _compiled(identifier, files) if compiled else None
    # Under another name until it is whole.
    handle, draft = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as out, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as fmu:
            for place, text in files.items():
                fmu.writestr(place, text)
            if binary is not None:
                fmu.writestr(*binary)
        os.chmod(draft, 0o644)
        os.replace(draft, path)
    except BaseException:
        os.unlink(draft)
        raise


def _compiled(identifier, files) -> tuple[str, bytes]:
    """The place and the bytes of the shared library."""
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc")
    if platform.system() != "Linux" or not compiler:
        raise CostateError(
            "the binary is compiled on Linux, with a C compiler (CC): leave out compiled=True, and let the tool that imports the FMU compile its source"
        )
    with tempfile.TemporaryDirectory(prefix="pycostate-") as folder:
        for name in ("law.h", "fmi3.c"):
            Path(folder, name).write_text(files[f"sources/{name}"], encoding="utf-8")
        library = Path(folder, f"{identifier}.so")
        command = [*compiler.split(), "-std=c99", "-O2", "-fPIC", "-shared", "fmi3.c", "-o", library.name, "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CostateError(f"the C compiler refuses the law: {done.stderr.strip()[:500]}")
        return f"binaries/{platform.machine()}-linux/{identifier}.so", library.read_bytes()
