"""Run a real filters.python pipeline in this process and in the pdal program."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pdal

SOURCE = "def f(ins, outs):\n    outs['Z'] = ins['Z'] + 1.0\n    return True\n"
STAGE = {"type": "filters.python", "source": SOURCE, "module": "m", "function": "f"}

array = np.zeros(3, [("X", "f8"), ("Y", "f8"), ("Z", "f8")])
pipeline = pdal.Pipeline(json.dumps([STAGE]), arrays=[array])
if pipeline.execute() != 3 or pipeline.arrays[0]["Z"][0] != 1.0:
    sys.exit("filters.python does nothing")
with tempfile.TemporaryDirectory() as folder:
    text = Path(folder) / "points.txt"
    text.write_text("X,Y,Z\n1,2,3\n")
    job = json.dumps([str(text), STAGE, str(text.with_name("out.txt"))])
    subprocess.run(["pdal", "pipeline", "--stdin"], input=job, text=True, check=True)
print(f"PDAL {pdal.info.version}, pdal {pdal.__version__}, numpy {np.__version__}")
