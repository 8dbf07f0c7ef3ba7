"""compose.yaml and the Dockerfiles against the services' real options (no engine is needed)."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
OURS = sorted(name for name in COMPOSE if name != "router")


def dockerfile(service: str) -> str:
    return (ROOT / COMPOSE[service]["build"]["dockerfile"]).read_text()


def module(service: str) -> str:
    found = re.search(r'ENTRYPOINT \["python", "-m", "([\w.]+)"\]', dockerfile(service))
    assert found, f"no module entry point in {COMPOSE[service]['build']['dockerfile']}"
    return found[1]


@pytest.mark.parametrize("service", OURS)
def test_every_option_in_compose_is_one_the_service_takes(service):
    help_text = subprocess.run(
        [sys.executable, "-m", module(service), "--help"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    ).stdout

    options = [word for word in COMPOSE[service]["command"] if word.startswith("--")]

    assert [option for option in options if f"{option} " not in help_text + " "] == []


@pytest.mark.parametrize("service", OURS)
def test_a_dockerfile_copies_only_what_exists(service):
    copied = re.findall(r"^COPY (.+) \S+$", dockerfile(service), re.MULTILINE)

    sources = [source for line in copied for source in line.split()]

    assert [source for source in sources if not (ROOT / source).exists()] == []


@pytest.mark.parametrize("service", OURS)
def test_a_dockerfile_installs_extras_that_exist(service):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    found = re.search(r'"\.\[([\w,]+)\]"', dockerfile(service))

    assert found and set(found[1].split(",")) <= set(project["optional-dependencies"])


@pytest.mark.parametrize("service", OURS)
def test_an_image_runs_without_root_and_has_a_health_check(service):
    text = dockerfile(service)

    assert "\nUSER pointslam\n" in text
    assert "\nHEALTHCHECK " in text


@pytest.mark.parametrize("service", OURS)
def test_services_wait_for_a_healthy_router(service):
    assert COMPOSE[service]["depends_on"]["router"]["condition"] == "service_healthy"
    assert "healthcheck" in COMPOSE["router"]


def test_only_the_gpu_profile_starts_the_gpu_mapper():
    with_profile = {name for name, service in COMPOSE.items() if "profiles" in service}

    assert with_profile == {"mapping-gpu"}


def test_ports_are_published_on_loopback_alone():
    ports = [port for service in COMPOSE.values() for port in service.get("ports", [])]

    assert ports and all(port.startswith("127.0.0.1:") for port in ports)
