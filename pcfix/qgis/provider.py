"""The Processing provider of pcfix in QGIS: its setting, and an algorithm for each command."""

import json
from pathlib import Path
from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis import core

from .command import CommandError, program_of, run, words_of

PROGRAM = "PCFIX_PROGRAM"
MESSAGES = "messages"
CLOUDS = "Point clouds and DSMs (*.las *.laz *.tif *.tiff *.vrt);;All files (*.*)"
OUTPUTS = "LAZ (*.laz);;LAS (*.las);;GeoTIFF (*.tif)"
LAYER = "raster_layer"  # field for a raster layer of the project, instead of the file of a cloud


class Plugin:
    """The plugin."""

    def __init__(self) -> None:
        self.provider: Any = None

    def initProcessing(self) -> None:  # noqa: N802
        """Add the algorithms to the toolbox; ``qgis_process`` calls only this."""
        self.provider = Provider()
        core.QgsApplication.processingRegistry().addProvider(self.provider)

    initGui = initProcessing  # noqa: N815 (QGIS with a window calls this)

    def unload(self) -> None:
        """Remove the algorithms."""
        if self.provider is not None:
            core.QgsApplication.processingRegistry().removeProvider(self.provider)


class Provider(core.QgsProcessingProvider):
    """The commands in ``commands.json``."""

    def id(self) -> str:
        """Return the prefix of the names of the algorithms."""
        return "pcfix"

    def name(self) -> str:
        """Return its name in the toolbox."""
        return "pcfix (refraction correction)"

    def load(self) -> bool:
        """Add the setting that names pcfix's environment."""
        words = "Environment with pcfix, or its program (empty: on the PATH)"
        ProcessingConfig.settingIcons["pcfix"] = self.icon()
        ProcessingConfig.addSetting(Setting("pcfix", PROGRAM, words, ""))
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        """Remove the setting."""
        ProcessingConfig.removeSetting(PROGRAM)

    def loadAlgorithms(self) -> None:  # noqa: N802
        """Add an algorithm for each command."""
        table = json.loads(Path(__file__).with_name("commands.json").read_text("utf-8"))
        for command in table["commands"]:
            self.addAlgorithm(Algorithm(command))


class Algorithm(core.QgsProcessingAlgorithm):
    """One command of pcfix."""

    def __init__(self, command: dict[str, Any]) -> None:
        super().__init__()
        self.command = command
        self.fields = [*command["places"], *command["options"]]

    def createInstance(self) -> "Algorithm":  # noqa: N802
        """Return a copy."""
        return Algorithm(self.command)

    def name(self) -> str:
        """Return the name after the prefix."""
        return str(self.command["name"])

    def displayName(self) -> str:  # noqa: N802
        """Return its name in the toolbox."""
        return str(self.command["name"]).capitalize()

    def shortHelpString(self) -> str:  # noqa: N802
        """Return what it does."""
        return str(self.command["help"])

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:  # noqa: N802
        """Declare arguments and options."""
        for one in self.fields:
            parameter = _parameter(one)
            parameter.setHelp(one["help"])
            if not one["needed"]:
                flag = core.QgsProcessingParameterDefinition.FlagAdvanced
                parameter.setFlags(parameter.flags() | flag)
            self.addParameter(parameter, createOutput=True)
            if one["kind"] == "cloud":
                words = "Raster layer of heights, instead of the cloud"
                layer = core.QgsProcessingParameterRasterLayer(LAYER, words, None, True)
                self.addParameter(layer)
        self.addOutput(core.QgsProcessingOutputString(MESSAGES, "Messages of pcfix"))

    def processAlgorithm(  # noqa: N802
        self, parameters: dict[str, Any], context: Any, feedback: Any
    ) -> dict[str, Any]:
        """Run pcfix and load its output."""
        values = {one["name"]: self._value(one, parameters, context) for one in self.fields}
        layer = self.parameterAsRasterLayer(parameters, LAYER, context)
        for one in self.fields:
            if one["kind"] == "cloud" and layer:
                values[one["name"]] = layer.source()
            if one["kind"] == "cloud" and not values[one["name"]]:
                raise core.QgsProcessingException("Give a cloud, or a raster layer.")
        lines: list[str] = []

        def say(line: str) -> None:
            lines.append(line)
            (feedback.pushWarning if "warning:" in line else feedback.pushInfo)(line)

        try:
            program = program_of(ProcessingConfig.getSetting(PROGRAM) or "")
            words = words_of(self.command, values)
            feedback.pushCommandInfo(" ".join(["pcfix", *words]))
            run(program, words, feedback.isCanceled, feedback.setProgress, say)
        except CommandError as error:
            raise core.QgsProcessingException(str(error)) from error
        outputs = (one["name"] for one in self.fields if one["kind"].endswith("written"))
        written = {name: values[name] for name in outputs if values[name]}
        for path in written.values():
            _load(Path(path), context)
        return {**written, MESSAGES: "\n".join(lines)}

    def _value(self, one: dict[str, Any], parameters: dict[str, Any], context: Any) -> Any:
        name, kind = one["name"], one["kind"]
        if parameters.get(name) is None and not one["needed"]:
            return None
        read: Any = {
            "bool": self.parameterAsBool, "int": self.parameterAsInt,
            "float": self.parameterAsDouble, "choice": self.parameterAsEnumString,
            "written": self.parameterAsFileOutput, "folder written": self.parameterAsFileOutput,
        }  # fmt: skip
        return read.get(kind, self.parameterAsString)(parameters, name, context)


def _parameter(one: dict[str, Any]) -> Any:
    """Return the field of a form for an argument or an option; only needed ones are required."""
    name, kind, default = one["name"], one["kind"], one["default"]
    label = name.replace("_", " ").capitalize() + (f" [{one['unit']}]" if one["unit"] else "")
    optional = not one["needed"] or kind == "cloud"  # or the raster layer
    file, number = core.QgsProcessingParameterFile, core.QgsProcessingParameterNumber
    if kind == "bool":
        return core.QgsProcessingParameterBoolean(name, label, default, optional)
    if kind in ("int", "float"):
        type_ = number.Integer if kind == "int" else number.Double
        return number(name, label, type_, default, optional)
    if kind == "choice":
        choices = one["choices"], False, default, optional
        return core.QgsProcessingParameterEnum(name, label, *choices, usesStaticStrings=True)
    if kind in ("file", "cloud", "folder"):
        behaviour = file.Folder if kind == "folder" else file.File
        clouds = {"fileFilter": CLOUDS} if kind == "cloud" else {}
        return file(name, label, behaviour, optional=optional, **clouds)
    default = None, optional, not optional
    if kind == "folder written":
        return core.QgsProcessingParameterFolderDestination(name, label, *default)
    if kind == "written":
        filters = OUTPUTS if one["needed"] else "All files (*.*)"
        return core.QgsProcessingParameterFileDestination(name, label, filters, *default)
    return core.QgsProcessingParameterString(name, label, default, False, optional)


def _load(path: Path, context: Any) -> None:
    """Load an output, or the rasters and vectors of a folder, with the style next to them."""
    paths = sorted(path.iterdir()) if path.is_dir() else [path]
    for one in paths:
        for layer in _layers(one):
            if layer.isValid():
                layer.loadDefaultStyle()
                context.temporaryLayerStore().addMapLayer(layer)
                details = core.QgsProcessingContext.LayerDetails
                shown = details(layer.name(), context.project(), "")
                context.addLayerToLoadOnCompletion(layer.id(), shown)


def _layers(path: Path) -> list[Any]:
    suffix = path.suffix.lower()
    if suffix == ".tif":
        return [core.QgsRasterLayer(str(path), path.stem)]
    if suffix in (".las", ".laz") and "pdal" in core.QgsProviderRegistry.instance().providerList():
        return [core.QgsPointCloudLayer(str(path), path.stem, "pdal")]
    if suffix == ".gpkg":
        found = core.QgsVectorLayer(str(path), path.stem, "ogr").dataProvider()
        names = [word.split("!!::!!")[1] for word in found.subLayers()] if found else []
        return [core.QgsVectorLayer(f"{path}|layername={name}", name, "ogr") for name in names]
    return []
