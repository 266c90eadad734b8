"""Whether a record is fit to be judged: levels of the channels, and faults that need no model of the rig."""

from .channel_summary import moments
from .clipping import clipping_level, pileup_p_value
from .findings import CLIPPED_CODE, ChannelSummary, RecordFinding, RecordSurvey
from .severity import ChannelSeverity, severity
from .spikes import spike_rows, surely_without_spikes
from .survey import survey_record
from .usable import UsableRecord, level_parameter, record_messages, usable_record, without_spikes
from .zones import iso_zone, zone_limits

__all__ = [
    "CLIPPED_CODE",
    "ChannelSeverity",
    "ChannelSummary",
    "RecordFinding",
    "RecordSurvey",
    "UsableRecord",
    "clipping_level",
    "iso_zone",
    "level_parameter",
    "moments",
    "pileup_p_value",
    "record_messages",
    "severity",
    "spike_rows",
    "surely_without_spikes",
    "survey_record",
    "usable_record",
    "without_spikes",
    "zone_limits",
]
