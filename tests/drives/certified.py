"""A certificate of `softneck verify` that arms, without the ten seconds that a real one takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softneck.core import file_hash, write_certificate
from softneck.core._certificate import certificate_contents
from softneck.verification import read_requirements

# What a certificate must show, and what of it draws show by other rows.
ARMING = (
    "stability.radius", "axes.disk_margin", "axes.gain_margin", "axes.delay_margin_ms", "step.overshoot_pct",
    "step.load_rms_deg", "sim.slack_s",
)  # fmt: skip
BY_DRAWS = ("stability.radius", "axes.disk_margin", "step.overshoot_pct", "step.load_rms_deg")


def verified_rows() -> dict[str, dict[str, Any]]:
    """Return the rows that arming needs, by metric: each holds, at the limit that `softneck verify` asks by default."""
    asked = {item.metric: item for item in read_requirements().bounds}
    return {
        name: {"metric": name, "bound": asked[name].bound, "limit": asked[name].limit, "value": 1.0, "holds": True}
        for name in ARMING
    }


def drawn_rows() -> dict[str, dict[str, Any]]:
    """Return the rows that arming needs where draws decided: linear ones are shown, and decide nothing."""
    rows, asked = verified_rows(), {item.metric: item for item in read_requirements().bounds}
    for name in BY_DRAWS:
        rows[name] |= {"holds": None, "note": "shown only"}
    limits = {name: asked[name].limit for name in ("sim.overshoot_pct",)} | {
        "sim.load_rms_deg": asked["step.load_rms_deg"].limit
    }
    more = {
        name: {"metric": name, "bound": "max", "limit": limit, "value": 1.0, "holds": True}
        for name, limit in limits.items()
    }
    return rows | more


def write_verified(
    controller: Path, rows: dict[str, dict[str, Any]] | None = None, path: Path | None = None, **more: Any
) -> Path:
    """Write the certificate, beside the controller if no path is given; `more` are further entries."""
    target = path or controller.with_name(f"{controller.stem}.certificate.json")
    listed = list((verified_rows() if rows is None else rows).values())
    contents = certificate_contents(
        "verify", holds=all(row["holds"] is not False for row in listed),
        files={"controller": (str(controller), file_hash(controller))}, more={"requirements": listed, **more},
    )  # fmt: skip
    write_certificate(target, contents, force=True)
    return target
