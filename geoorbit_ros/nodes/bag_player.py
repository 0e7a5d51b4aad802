"""Node `bag_player`: a recording becomes live topics again."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import UInt64
from std_srvs.srv import SetBool

from geoorbit_ros.conversions import encode_clock, message_class
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.storage.bag_reader import BagMessage, bag_messages, describe_bag
from geoorbit_ros.storage.playback import Playback, begun_at, endless, played_topics

TICK_S = 0.005
"""Between two looks at what is due. Chosen: larger, messages come later than in the recording, by
up to this; smaller costs processor time."""
BATCH = 50
"""Messages per tick at most. Chosen: larger, the other nodes of a process wait longer for their
turn; smaller, fast playing takes longer."""
CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""As rclcpp's ClockQoS: the newest time only."""
ACKNOWLEDGE_TIMEOUT = Duration(seconds=10)
"""At the end, for reliable readers to take the last messages. Chosen: larger, a reader that has
stopped holds up the end; smaller, one that is slow loses messages."""


@dataclass(frozen=True, slots=True)
class BagPlayerParameters:
    """See params/bag_player.yaml."""

    bag: str
    topics: str
    rate: float
    loop: bool
    stamp_now: bool
    start_offset_s: float
    max_gap_s: float
    camera_id: str
    publish_clock: bool
    reliability: str
    queue_depth: int
    wait_for_subscribers: int
    wait_timeout_s: float
    start_paused: bool
    exit_when_done: bool


class BagPlayerNode(GeoOrbitNode[BagPlayerParameters]):
    """Publishes the messages of a bag, as recorded, and `/clock`.

    At the end the number of messages played is published, latched, on `~/finished`. The service
    `~/pause` holds (true) and resumes (false).

    Attributes:
        finished: Whether the bag has been played to its end.
        may_send: How many messages the readers can take now; set by code that runs the player and
            its readers in one process.
    """

    name = "bag_player"
    struct = BagPlayerParameters

    def setup(self) -> None:
        """Open the bag and make its topics."""
        p = self.p
        self.may_send: Callable[[], int] = lambda: BATCH
        self.paused, self.finished = p.start_paused, False
        self.topics: dict[str, Publisher] = {}
        qos = stream_qos(p.reliability, p.queue_depth)
        info = describe_bag(p.bag)
        self._remarks = list(info.report.sentences())
        wanted = [t for t in info.topics if not p.topics or t.name in p.topics.split()]
        names = played_topics([topic.name for topic in wanted], p.camera_id, p.bag)
        self._types: dict[str, str] = {}
        for topic in wanted:
            kind = topic.message_type
            message_type = message_class(kind) if topic.readable else None
            if topic.name == "/clock" and p.publish_clock:
                self._remarks.append("/clock is not played, as the player has its own")
            elif message_type is None or topic.name in self._types:
                self._remarks.append(f"{topic.name}: {kind or topic.encoding} is not played")
            elif topic.name in names:
                self._types[topic.name] = kind
                publisher = self.create_publisher(message_type, names[topic.name], qos)
                self.topics[topic.name] = publisher
        for sentence in self._remarks:
            self.get_logger().warning(f"{p.bag}: {sentence}")
        self._clock_topic = self.create_publisher(ClockMessage, "/clock", CLOCK_QOS)
        self._finished_topic = self.create_publisher(UInt64, "~/finished", LATCHED)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self._waiting, self._deadline_s = True, time.monotonic() + p.wait_timeout_s
        self._begin(p)
        if self._playback.finished:
            raise InputFileError(p.bag, "no message to play", "a bag with messages")
        self.create_timer(TICK_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def diagnostic_values(self) -> Mapping[str, object]:
        """Where in the recording it is, and what is wrong with it."""
        return {
            "bag_time_s": self._playback.time_ns / 1e9,
            "paused": self.paused,
            "bag_remarks": "; ".join(self._remarks),
        }

    def _recorded(self) -> Iterator[BagMessage]:
        """The bag's messages from its beginning, of the types that are played."""
        for message in bag_messages(self.p.bag, tuple(self.topics)):
            if message.message_type == self._types[message.topic]:
                yield message

    def _begin(self, p: BagPlayerParameters) -> None:
        messages = endless(self._recorded) if p.loop else self._recorded()
        if p.stamp_now:
            messages = begun_at(messages, time.time_ns())
        self._playback = Playback(messages, p.rate, p.max_gap_s, p.start_offset_s)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.paused = request.data
        self._playback.hold()
        response.success, response.message = True, "paused" if self.paused else "playing"
        return response

    def _tick(self) -> None:
        if self.finished or self.paused:
            return
        if self._waiting:
            wanted, topics = self.p.wait_for_subscribers, self.topics.values()
            lonely = [t.topic for t in topics if t.get_subscription_count() < wanted]
            if lonely and time.monotonic() < self._deadline_s:
                return
            if lonely:
                self.get_logger().warning(f"playing without subscribers on {', '.join(lonely)}")
            self._waiting = False
            self._begin(self.p)  # once more: stamps of the present begin now
        for message in self._playback.due(time.monotonic(), min(BATCH, self.may_send())):
            self.publish_stream(self.topics[message.topic], message.cdr)
        if self.p.publish_clock:
            self._clock_topic.publish(encode_clock(self._playback.time_ns))
        if self._playback.finished:
            self._end()

    def _end(self) -> None:
        self._finished_topic.publish(UInt64(data=self.diagnostics.published))
        self.get_logger().info(f"{self.p.bag}: played {self.diagnostics.published} messages")
        self.finished, self.done = True, self.p.exit_when_done

    def close(self) -> None:
        """Give reliable subscribers time to take the last messages."""
        topics = self.topics.values() if self.finished and not self.told_to_end else ()
        if not all(topic.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT) for topic in topics):
            self.get_logger().warning("the last messages were not acknowledged within 10 s")


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(BagPlayerNode, args)


if __name__ == "__main__":
    sys.exit(main())
