"""Exports that other programs read as tables: universal files, HDF5, Parquet. Units and date are in each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.base.console.extras import required
from daq.base.contract.errors import LogError
from daq.rig.units import UNITS_OF_KIND

if TYPE_CHECKING:
    from .exporters import Table

UFF_DATA_TYPE = {"acceleration": 12, "velocity": 11, "displacement": 8, "force": 9}  # of an axis, dataset 58
UFF_TIME_TYPE, UFF_GENERAL_TYPE = 17, 1
UFF_TIME_RESPONSE = 1
UFF_DOUBLE_REAL = 4
UFF_NAME_CHARACTERS = 80


def write_uff(table: Table, path: Path) -> None:
    """Dataset 58, a time response for each channel, in text that every modal program reads."""
    pyuff = required("pyuff", "formats", ".uff")
    if np.isnan(table.values).any():
        raise LogError(".uff: a universal file cannot hold missing samples; export a part without a gap (--from, --to)")
    file = pyuff.UFF(str(path))
    time = np.arange(len(table.values)) / table.rate_hz
    sets = []
    for k, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
        kind = next((kind for kind, units in UNITS_OF_KIND.items() if unit in units), "")
        record = pyuff.prepare_58(
            binary=0, func_type=UFF_TIME_RESPONSE, ver_num=1, load_case_id=0, rsp_ent_name=name[:10], rsp_node=k + 1,
            rsp_dir=1, ref_ent_name="NONE", ref_node=0, ref_dir=0, data=table.values[:, k], x=time, num_pts=len(time),
            id1=name[:UFF_NAME_CHARACTERS], id2="rotorscope", id3=table.started, id4="", id5="",
            ord_data_type=UFF_DOUBLE_REAL, abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1.0 / table.rate_hz,
            abscissa_spec_data_type=UFF_TIME_TYPE, z_axis_spec_data_type=0, z_axis_value=0.0,
            ordinate_spec_data_type=UFF_DATA_TYPE.get(kind, UFF_GENERAL_TYPE), orddenom_spec_data_type=0,
        )  # fmt: skip
        axes = {"abscissa_axis_lab": "Time", "abscissa_axis_units_lab": "s"}
        axes |= {"ordinate_axis_lab": kind.capitalize() or "NONE", "ordinate_axis_units_lab": unit or "NONE"}
        sets.append(record | axes)
    file.write_sets(sets, mode="overwrite")


def write_hdf5(table: Table, path: Path) -> None:
    """A dataset for each channel with its unit; rate and date are attributes of the file."""
    h5py = required("h5py", "formats", ".h5")
    with h5py.File(path, "w") as file:
        file.attrs["rate_hz"] = table.rate_hz
        if table.started:
            file.attrs["started"] = table.started
        for k, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
            file.create_dataset(name, data=table.values[:, k], compression="gzip", shuffle=True).attrs["unit"] = unit


def write_parquet(table: Table, path: Path) -> None:
    """A column for each channel with its unit; rate and date are metadata of the schema."""
    pyarrow = required("pyarrow", "formats", ".parquet")
    parquet = required("pyarrow.parquet", "formats", ".parquet")
    about = {"rate_hz": repr(table.rate_hz)} | ({"started": table.started} if table.started else {})
    fields = [
        pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit})
        for name, unit in zip(table.names, table.units, strict=True)
    ]
    schema = pyarrow.schema(fields, metadata=about)
    columns = [np.ascontiguousarray(table.values[:, k]) for k in range(len(table.names))]
    parquet.write_table(pyarrow.Table.from_arrays(columns, schema=schema), path, compression="zstd")
