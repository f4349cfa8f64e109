"""A scripted module of 3D Slicer: the bone surface of a DICOM folder by the command line of clrecon, as a model.

In Slicer: Edit, Application Settings, Modules, Additional module paths, and there the folder of this file.  clrecon is
not installed in Slicer's Python; the module asks for the path of the command.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

try:
    from slicer.ScriptedLoadableModule import ScriptedLoadableModule, ScriptedLoadableModuleWidget
except ImportError:  # outside of Slicer, where the functions below are tested
    ScriptedLoadableModule = ScriptedLoadableModuleWidget = object

SURFACES = ("cortex", "hu")


def make_surface(program: str, folder: str, output: str, surface: str = "cortex") -> dict[str, Any]:
    """Run clrecon and return its report; an error has the line that clrecon printed.

    Raises
    ------
    RuntimeError
        The command is not there, or ends with another exit code than 0.
    """
    command = [program, "mesh", folder, "-o", output, "--surface", surface, "--hu", "200", "--json", "--quiet"]
    # Slicer's own Python is named in its environment, and would be taken by the Python of clrecon.
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH")}
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    except OSError as error:
        raise RuntimeError(f"{program} cannot be run: {error.strerror}") from error
    report = json.loads(done.stdout or "{}")
    if done.returncode:
        raise RuntimeError(report.get("error", {}).get("message") or done.stderr.strip() or f"exit {done.returncode}")
    return dict(report)


class ClreconSurface(ScriptedLoadableModule):
    """What Slicer's list of modules shows."""

    def __init__(self, parent: Any) -> None:
        super().__init__(parent)
        parent.title = "Bone surface (clrecon)"
        parent.categories = ["Surface Models"]
        parent.helpText = "The bone surface of a DICOM folder, made by the command clrecon."


class ClreconSurfaceWidget(ScriptedLoadableModuleWidget):
    """The panel: path of the command, folder of the scan, kind of surface, and a button."""

    def setup(self) -> None:
        import ctk
        import qt

        super().setup()
        self.program, self.folder = ctk.ctkPathLineEdit(), ctk.ctkPathLineEdit()
        self.program.currentPath = "clrecon"
        self.folder.filters = ctk.ctkPathLineEdit.Dirs
        self.surface, button = qt.QComboBox(), qt.QPushButton("Make the surface")
        self.surface.addItems(SURFACES)
        form = qt.QFormLayout()
        for label, widget in (("Command", self.program), ("DICOM folder", self.folder), ("Surface", self.surface)):
            form.addRow(label, widget)
        form.addRow(button)
        self.layout.addLayout(form)
        button.connect("clicked()", self.show_surface)

    def show_surface(self) -> None:
        """Make the surface and load it as a model; clrecon's PLY names its frame, which Slicer reads."""
        import slicer

        with tempfile.TemporaryDirectory() as temporary:
            output = str(Path(temporary, "bone.ply"))
            try:
                make_surface(self.program.currentPath, self.folder.currentPath, output, self.surface.currentText)
            except RuntimeError as error:
                slicer.util.errorDisplay(str(error))
                return
            slicer.util.loadModel(output)
