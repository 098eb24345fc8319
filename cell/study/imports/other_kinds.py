"""Known kinds of files that are not read, with the export of each that is."""

from __future__ import annotations

from pathlib import Path

from cell.files.input_error import InputError

#: Key of the description of a rosbag2, and names of the tables of one that is a database.
OF_BAG, BAG_TABLES = "rosbag2_bagfile_information", frozenset(("topics", "messages"))
BAG_METADATA = "metadata.yaml"
_TO_MCAP = "`rosbags-convert --src {} --dst OUT --dst-storage mcap`, of pip's rosbags, makes an "
_TO_MCAP += ".mcap in the folder OUT, which is read"
_MDF = (
    "a measurement in MDF; asammdf makes a CSV of each of its groups, with the group's own times: "
)
_MDF += "MDF('{}').export('csv', 'OUT', time_from_zero=False)"
_PYTHON = "of Python's objects, which run code when read; save arrays by numpy.savez, or a table "
_PYTHON += "by to_csv"
#: The kind of each ending, and its export; {} is the file's path.
EXPORTS = {
    ".bag": f"a recording of ROS 1; {_TO_MCAP}",
    **dict.fromkeys((".mf4", ".mdf"), _MDF),
    ".blf": "a log of raw CAN frames; decode it by its .dbc, and export the signals as CSV",
    **dict.fromkeys((".uff", ".unv", ".dxd", ".d7d"), "a measurement; export its channels as CSV"),
    ".tak": "a take of Motive; export its tracking data as CSV",
    ".qtm": "a measurement of Qualisys; export it as TSV or C3D",
    **dict.fromkeys((".pkl", ".pickle"), _PYTHON),
    **dict.fromkeys((".zip", ".gz", ".7z", ".zst"), "packed; unpack it"),
}


def bag_error(path: Path, verb: str = "is") -> InputError:
    """The error of a file that is, or describes, a recording of rosbag2 in a database."""
    message = f"{verb} a recording of rosbag2: give its .mcap; of a .db3, "
    return InputError.at(path, message + _TO_MCAP.format(path.parent))
