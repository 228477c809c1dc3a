"""Reading npz files that may come from anywhere."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

PLAIN_METHODS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})
"""Ways of packing that unpack piece by piece; of the others a small file can take any memory."""
_MAX_MEMBERS = 1000


def read_npz(source: BinaryIO | bytes, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz file; nothing is unpickled, and no size is believed.

    Parameters
    ----------
    source : binary file or bytes
        The archive.
    max_bytes : int
        Bytes that its members may take unpacked.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    ValueError
        If it is no such file: whatever is wrong with it.
    """
    try:
        file = io.BytesIO(source) if isinstance(source, bytes) else source
        size = file.seek(0, io.SEEK_END)
        with zipfile.ZipFile(file) as archive:
            infos = archive.infolist()
            # memory is set aside for as much as a member claims to have in the file
            if any(info.compress_size > size for info in infos):
                raise ValueError(f"a member of more than the file's {size:,} bytes")
            if len(infos) > _MAX_MEMBERS or sum(info.file_size for info in infos) > max_bytes:
                raise ValueError(f"{len(infos)} members, or more than {max_bytes:,} bytes unpacked")
            if any(info.compress_type not in PLAIN_METHODS for info in infos):
                raise ValueError("it is packed in another way than stored or deflated")
            return {info.filename.removesuffix(".npy"): parse_npy(archive.read(info)) for info in infos}
    except MemoryError:
        raise
    except Exception as error:  # damaged archives raise a dozen kinds, struct.error and zlib.error among them
        raise ValueError(str(error) or type(error).__name__) from error


def parse_npy(data: bytes) -> NDArray[Any]:
    """Return the array in the bytes of an npy file.

    Raises
    ------
    ValueError
        If it holds objects or claims another size than it has.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"npy version {version}, expected (1, 0)")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or any(type(n) is not int or n < 0 for n in shape):
        raise ValueError(f"{dtype} of shape {shape}, expected plain numbers")
    if dtype.itemsize * math.prod(shape) != len(data) - stream.tell():
        raise ValueError(f"shape {shape} does not fit its bytes")
    return np.array(np.ndarray(shape, dtype, data, stream.tell(), order="F" if fortran else "C"))
