"""Where on Earth a session's map is, in a file of its folder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from services.mapping.storage.folders import SessionFolder, storage_errors, write_atomically
from shared import codec
from shared.errors import InputError, StorageError
from shared.georeference import Georeference, GeoreferenceReply, GeoreferenceRequest

_FILE = "georeference.msgpack"


def georeference_answer(
    folder: SessionFolder, check_lease: Callable[[], object]
) -> tuple[str, type, Callable[[Any], object]]:
    """The question `georeference` of `Keys.session`, and who answers it.

    Setting it raises what `check_lease` raises: an owner of an older epoch must not write.
    """
    path = folder.path / _FILE

    def answer(request: GeoreferenceRequest) -> GeoreferenceReply:
        if request.new is not None:
            check_lease()
            write_atomically(path, codec.pack(request.new))
        if not path.is_file():
            return GeoreferenceReply()
        try:
            with storage_errors(str(path)):
                return GeoreferenceReply(codec.unpack(Georeference, path.read_bytes()))
        except InputError as error:
            raise StorageError(f"{path}: {error}") from None

    return "georeference", GeoreferenceRequest, answer
