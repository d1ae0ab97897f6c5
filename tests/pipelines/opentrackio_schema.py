"""The parts of the OpenTrackIO 1.0.1 schema that our samples use, restated from the published one.

The same keys, types, ranges and required members, and the same refusal of unknown keys. No package registry has the
published file. What could be read of the public camdkit repository is from before 1.0.1 and agrees but for two names
(focalLength; the time code's frameRate, which stood within format). test_exports.py checks against the file itself
where OPENTRACKIO_SCHEMA names one.
"""

from __future__ import annotations

from typing import Any

RATE = {
    "type": "object", "additionalProperties": False, "required": ["num", "denom"],
    "properties": {"num": {"type": "integer", "minimum": 1, "maximum": 2147483647},
                   "denom": {"type": "integer", "minimum": 1, "maximum": 4294967295}},
}  # fmt: skip
URN = {
    "type": "string",
    "pattern": "^urn:uuid:[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$",
}
TEXT = {"type": "string", "minLength": 1, "maxLength": 1023}
NUMBER = {"type": "number"}


def block(required: list[str], **properties: Any) -> dict[str, Any]:
    return {
        "type": "object", "additionalProperties": False, "required": required, "properties": properties,
    }  # fmt: skip


OPENTRACKIO_SCHEMA = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "type": "object",
    "properties": {
        "protocol": block(
            ["name", "version"],
            name=TEXT,
            version={
                "type": "array", "minItems": 3, "maxItems": 3,
                "items": {"type": "integer", "minimum": 0, "maximum": 9},
            },
        ),
        "sampleId": URN,
        "sourceId": URN,
        "sourceNumber": {"type": "integer", "minimum": 0, "maximum": 4294967295},
        "static": block(
            [],
            camera=block(
                [],
                captureFrameRate=RATE,
                activeSensorPhysicalDimensions=block(
                    ["height", "width"],
                    height={"type": "number", "minimum": 0},
                    width={"type": "number", "minimum": 0},
                ),
                activeSensorResolution=block(
                    ["height", "width"],
                    height={"type": "integer", "minimum": 0, "maximum": 2147483647},
                    width={"type": "integer", "minimum": 0, "maximum": 2147483647},
                ),
            ),
        ),
        "timing": block(
            [],
            mode={"type": "string", "enum": ["internal", "external"]},
            sampleRate=RATE,
            sequenceNumber={"type": "integer", "minimum": 0, "maximum": 4294967295},
            sampleTimestamp=block(
                ["seconds", "nanoseconds"],
                seconds={"type": "integer", "minimum": 0, "maximum": 281474976710655},
                nanoseconds={"type": "integer", "minimum": 0, "maximum": 4294967295},
            ),
            timecode=block(
                ["hours", "minutes", "seconds", "frames", "frameRate"],
                hours={"type": "integer", "minimum": 0, "maximum": 23},
                minutes={"type": "integer", "minimum": 0, "maximum": 59},
                seconds={"type": "integer", "minimum": 0, "maximum": 59},
                frames={"type": "integer", "minimum": 0, "maximum": 119},
                frameRate=RATE,
            ),
        ),
        "tracker": block([], notes=TEXT, recording={"type": "boolean"}, slate=TEXT, status=TEXT),
        "lens": block(
            [],
            pinholeFocalLength={"type": "number", "minimum": 0},
            projectionOffset=block(["x", "y"], x=NUMBER, y=NUMBER),
            distortion={
                "type": "array", "minItems": 1,
                "items": block(
                    ["radial"],
                    model=TEXT,
                    radial={"type": "array", "minItems": 1, "items": NUMBER},
                    tangential={"type": "array", "minItems": 1, "items": NUMBER},
                ),
            },
        ),
        "transforms": {
            "type": "array", "minItems": 1,
            "items": block(
                ["translation", "rotation"],
                translation=block([], x=NUMBER, y=NUMBER, z=NUMBER),
                rotation=block([], pan=NUMBER, tilt=NUMBER, roll=NUMBER),
                id=TEXT,
            ),
        },
    },
    "additionalProperties": False,
}  # fmt: skip
