"""Reads everything in docker/ that an engine or an orchestrator would read, and prints it as one JSON object.

usage: containers.py DOCKER_FOLDER
"""

import json
import re
import shlex
import sys
from pathlib import Path

from ruamel.yaml import YAML

FOLDER = Path(sys.argv[1])


def documents(path):
    return [d for d in YAML(typ="safe", pure=True).load_all(path.read_text()) if d is not None]


def dockerfile(path):
    text = re.sub(r"\\\n", " ", path.read_text())
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
    instructions = [{"do": line.split(None, 1)[0], "rest": line.split(None, 1)[1]} for line in lines]
    for instruction in instructions:
        rest = instruction["rest"]
        if instruction["do"] == "HEALTHCHECK":
            instruction["check"] = json.loads(rest[rest.index("CMD") + 3 :])
        elif rest.startswith("["):
            instruction["list"] = json.loads(rest)
        elif instruction["do"] == "COPY":
            words = shlex.split(rest)
            instruction["from"] = next((w[7:] for w in words if w.startswith("--from=")), None)
            paths = [w for w in words if not w.startswith("--")]
            instruction["sources"], instruction["to"] = paths[:-1], paths[-1]
    return instructions


def compose(path):
    (document,) = documents(path)
    for service in document["services"].values():
        environment = service.get("environment") or {}
        if isinstance(environment, list):
            service["environment"] = dict(item.split("=", 1) for item in environment)
    return {"document": document, "variables": sorted(set(re.findall(r"\$\{(\w+)", path.read_text()))), "text": path.read_text()}


print(
    json.dumps(
        {
            "dockerfile": dockerfile(FOLDER / "Dockerfile"),
            "compose": {p.name: compose(p) for p in sorted(FOLDER.glob("compose*.yaml"))},
            "kubernetes": {p.name: documents(p) for p in sorted((FOLDER / "kubernetes").glob("*.yaml"))},
        }
    )
)
