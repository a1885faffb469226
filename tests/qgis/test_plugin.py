"""The plugin of QGIS: its table, its words, its process, and the same bytes under Debian's QGIS."""

import importlib
import io
import json
import os
import shutil
import subprocess
import sys
import types
import zipfile
from unittest import mock

import pytest

import pcfix
from pcfix.cli.commands import COMMANDS
from pcfix.cli.flags import OFFERED, plugin_table
from pcfix.flow.demo import write_scene
from pcfix.io.files import packed_plugin
from pcfix.options.correct import RunOptions
from pcfix.options.declare import options_of
from pcfix.qgis.command import CommandError, program_of, words_of

QGIS = shutil.which("qgis_process.bin") or shutil.which("qgis_process")


@pytest.fixture(scope="module")
def packed():
    return packed_plugin(plugin_table(COMMANDS), pcfix.__version__)


@pytest.fixture(scope="module")
def commands(packed):
    with zipfile.ZipFile(io.BytesIO(packed)) as file:
        table = json.loads(file.read("pcfix/commands.json"))
    return {one["name"]: one for one in table["commands"]}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_scene(pcfix.simulate_scene(1000), folder, overwrite=True)
    return folder


def test_options(commands):
    assert tuple(commands) == OFFERED
    assert [one["kind"] for one in commands["run"]["places"]] == ["cloud", "folder written"]
    shown = [one.name for one in options_of(RunOptions)]
    found = {one["name"]: one for one in commands["run"]["options"]}
    assert list(found) == shown
    assert found["water"]["needed"]
    assert not found["cameras"]["needed"]  # but with a method that looks at none
    assert found["method"]["choices"][:2] == ["auto", "snell"]
    kinds = {one["kind"] for one in (*found.values(), *commands["correct"]["options"])}
    assert kinds == {"bool", "int", "float", "choice", "file", "written", "text"}


def test_command_line(commands):
    values = {
        "input": "a b.laz", "output": "o.laz", "water": "-0.37", "sigma_image": 0.5, "deep": True,
        "sigma_index": 0.01, "method": "auto", "overwrite": False, "views": "", "max_angle": None,
    }  # fmt: skip
    assert words_of(commands["correct"], values) == [
        "correct", "a b.laz", "o.laz", "--water=-0.37", "--sigma-index=0.01", "--deep",
    ]  # fmt: skip
    sections = {"cloud": "a.laz", "reference": "b.laz", "section": "0,0,1,1; 2,2,3,3"}
    expected = ["compare", "a.laz", "b.laz", "--section=0,0,1,1", "--section=2,2,3,3"]
    assert words_of(commands["compare"], sections) == expected


def test_raster_layer(commands, monkeypatch):
    """A raster layer of the project replaces the file of the cloud; one of the two is needed."""
    qgis = mock.MagicMock()
    qgis.core.QgsProcessingException = RuntimeError
    qgis.ProcessingConfig.getSetting.return_value = sys.executable
    qgis.core.QgsProcessingProvider = qgis.core.QgsProcessingAlgorithm = type(
        "Base", (), {"addParameter": lambda *given, **more: None, "addOutput": lambda *given: None}
    )
    for name in ("qgis", "processing", "processing.core", "processing.core.ProcessingConfig"):
        monkeypatch.setitem(sys.modules, name, qgis)
    monkeypatch.delitem(sys.modules, "pcfix.qgis.provider", raising=False)
    provider = importlib.import_module("pcfix.qgis.provider")
    ran = []
    monkeypatch.setattr(provider, "run", lambda program, words, *more: ran.append(words))
    monkeypatch.setattr(provider, "_load", lambda *given: None)
    layer = types.SimpleNamespace(source=lambda: "/survey/dsm.tif")
    for name in ("run", "correct", "label", "compare"):
        one = provider.Algorithm(commands[name])
        one._value = lambda field, parameters, context: parameters.get(field["name"], "")
        for chosen, file in ((layer, ""), (None, "cloud.laz")):
            one.parameterAsRasterLayer = lambda *given, chosen=chosen: chosen
            one.processAlgorithm({"input": file, "cloud": file}, None, mock.MagicMock())
            assert ran[-1][:2] == [name, "/survey/dsm.tif" if chosen else "cloud.laz"]
        with pytest.raises(RuntimeError, match="raster layer"):
            one.processAlgorithm({}, None, mock.MagicMock())
    sys.modules.pop("pcfix.qgis.provider")


def test_no_pcfix(tmp_path):
    for setting in (str(tmp_path), str(tmp_path / "none")):
        with pytest.raises(CommandError, match="There is no pcfix at"):
            program_of(setting)
    program = tmp_path / "bin" / "pcfix"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert program_of(str(tmp_path)) == program_of(str(program)) == str(program)


@pytest.fixture(scope="module")
def qgis(packed, tmp_path_factory):
    """Return what runs an algorithm in a profile of its own, with the plugin and its setting."""
    if QGIS is None:
        pytest.skip("qgis_process is not installed")
    root = tmp_path_factory.mktemp("qgis")
    profile = root / "profiles" / "default"
    (profile / "QGIS").mkdir(parents=True)
    with zipfile.ZipFile(io.BytesIO(packed)) as file:
        file.extractall(profile / "python" / "plugins")
    program = root / "pcfix"
    python = f"PYTHONPATH='{os.pathsep.join(sys.path)}' exec '{sys.executable}'"
    program.write_text(f'#!/bin/sh\n{python} -m pcfix "$@"\n')
    program.chmod(0o755)

    def call(name: str, setting: str = str(program), **values: object):
        (profile / "QGIS" / "QGIS3.ini").write_text(
            "[PythonPlugins]\npcfix=true\nprocessing=true\n\n"
            f"[Processing]\nConfiguration\\PCFIX_PROGRAM={setting}\n"
        )
        words = [f"{key}={value}" for key, value in values.items()]
        # QGIS needs the Python that it was built with, not that of a virtual environment
        settings = {"QGIS_CUSTOM_CONFIG_PATH": str(root), "QT_QPA_PLATFORM": "offscreen"}
        settings["PATH"] = os.defpath
        return subprocess.run(
            [QGIS, "run", f"pcfix:{name}", "--", *words], capture_output=True, text=True,
            env=os.environ | settings, check=False,
        )  # fmt: skip

    return call


def test_same_bytes(qgis, scene, tmp_path):
    given = {"cameras": scene / "cameras.csv", "water": 0.37, "method": "snell"}
    done = qgis("correct", input=scene / "cloud.laz", output=tmp_path / "qgis.laz", **given)
    assert done.returncode == 0, done.stderr
    assert "Corrected" in done.stdout
    pcfix.correct_file(scene / "cloud.laz", tmp_path / "python.laz", **given)
    assert (tmp_path / "qgis.laz").read_bytes() == (tmp_path / "python.laz").read_bytes()
