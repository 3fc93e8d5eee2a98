"""What may run on drives: files whose certificates, by hash, are for exactly them and hold."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from softneck.core import CheckFailedError, check_certificate, file_hash, read_certificate
from softneck.core._certificate import certificate_path
from softneck.cosim.loops._setup import LoopSetup


def files_that_act(setup: LoopSetup, controller: Path) -> list[Path]:
    """Return the files of a run that a certificate must cover: all but the plant, which is hardware now."""
    roles = {role: Path(path) for role, (path, _) in setup.files.items() if role not in ("plant", "controller")}
    return [controller, *roles.values()]


def require_certified(
    setup: LoopSetup, controller: Path, certificates: Sequence[Path], override: Collection[str] = ()
) -> tuple[Path, ...]:
    """Return the certificates that cover controller, observer and loop file; all that are given must hold.

    Args:
        setup: the loop.
        controller: the file that is to run.
        certificates: of `softneck verify` and `softneck simulate --certificate`; where none is given, the one beside
            the controller.
        override: "certificate" in it lets everything pass.

    Raises:
        FileFormatError: no certificate, damaged or edited.
        CheckFailedError: one does not hold, or a file is not covered by any.
    """
    if "certificate" in override:
        return ()
    given = list(certificates)
    beside = certificate_path(controller)
    if not given and beside.is_file():
        given = [beside]
    if not given:
        raise CheckFailedError(
            f"{controller}: has no certificate; `softneck simulate LOOP.toml --certificate FILE` writes one for loop, "
            "observer and controller. Give it with --certificate, or let it pass by name with --override certificate."
        )
    covered: set[str] = set()
    for path in given:
        found = check_certificate(path, [], kind=read_certificate(path).kind)
        covered |= {digest for _, digest in found.files.values()}
    for item in files_that_act(setup, controller):
        if file_hash(item) not in covered:
            names = ", ".join(str(path) for path in given)
            raise CheckFailedError(
                f"{item}: is not what was certified ({names}), or was changed since; simulate and verify it again, or "
                "let it pass by name with --override certificate."
            )
    return tuple(given)
