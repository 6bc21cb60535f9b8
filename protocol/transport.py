"""Transport of the wire over ZeroMQ: streams by publisher and mailbox, control by request and reply."""

from protocol.publisher import Publisher
from protocol.receiver import Receiver
from protocol.request import ReplyServer, RequestClient
from protocol.sockets import check_endpoint
from protocol.subscriber import ReceivedMultipart

__all__ = ["Publisher", "ReceivedMultipart", "Receiver", "ReplyServer", "RequestClient", "check_endpoint"]
