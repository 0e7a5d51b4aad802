"""Names of classes: COCO's, and which names are vehicles."""

from __future__ import annotations

import re
from collections.abc import Sequence

from geoorbit_ros.core.tables import BUS, CAR, MOTORCYCLE, TRUCK

_WORDS = {
    CAR: "car cars vehicle vehicles automobile sedan hatchback suv van vans minivan taxi jeep",
    MOTORCYCLE: "motorcycle motorcycles motorbike motorbikes motor scooter moped",
    BUS: "bus buses minibus coach",
    TRUCK: "truck trucks lorry lorries trailer semitrailer semi tractor pickup ambulance",
}
_CLASS_OF = {word: number for number, words in _WORDS.items() for word in words.split()}

# Lin et al., Microsoft COCO (2014), the 80 classes of the 2017 detection task in their order.
_COCO = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,"
    "stop sign,parking meter,bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,"
    "backpack,umbrella,handbag,tie,suitcase,frisbee,skis,snowboard,sports ball,kite,baseball bat,"
    "baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,knife,spoon,"
    "bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,"
    "potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,"
    "oven,toaster,sink,refrigerator,book,clock,vase,scissors,teddy bear,hair drier,"
    "toothbrush"
)
COCO_NAMES = tuple(_COCO.split(","))
_NO_COCO = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""Numbers from 0 to 90 that the data set has no class for."""
COCO_91 = dict(zip((k for k in range(91) if k not in _NO_COCO), COCO_NAMES, strict=True))
"""The same by the numbers of the data set's files, as torchvision and DETR models write them."""


def vehicle_class(name: str) -> int | None:
    """COCO number of a class called `name`; None when that is no motor vehicle.

    The last known word of the name decides: a police car is a car, a `big truck` a truck. A van
    counts as a car, as in COCO.
    """
    for word in reversed(re.findall(r"[a-z]+", name.lower())):
        if word in _CLASS_OF:
            return _CLASS_OF[word]
    return None


def class_text(number: int) -> str:
    """Name of a COCO class, or `unknown`."""
    return COCO_NAMES[number] if 0 <= number < len(COCO_NAMES) else "unknown"


def shorten(names: Sequence[str], limit: int = 6) -> str:
    """The first names of a list, for a sentence."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")
