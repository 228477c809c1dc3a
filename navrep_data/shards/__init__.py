"""The on-disk format: write, read and verify shards; manifest, worlds files and dataset card. No torch."""

from navrep_data.shards._layout import chunk_rows, column_order, estimate_bytes
from navrep_data.shards.card import dataset_card
from navrep_data.shards.content import choose_shards, content_hash, select_shards
from navrep_data.shards.dataset_writer import DatasetWriter
from navrep_data.shards.entries import (
    FILE_NAME,
    INDEX_FILE,
    SPLIT_RULE,
    SPLITS,
    FileEntry,
    Ranges,
    SequenceSource,
    ShardEntry,
    count_in_split,
    count_of,
    nth_of_split,
    numbers_of,
    ranges_of,
    shard_file,
    split_of,
    worlds_file,
)
from navrep_data.shards.folder import DatasetFolder, Episodes, dataset_record, info
from navrep_data.shards.lock import LOCK_FILE, writer_lock
from navrep_data.shards.manifest import CARD_FILE, MANIFEST_FILE, Manifest
from navrep_data.shards.origin import ORIGIN_FILE, Origin, read_origin
from navrep_data.shards.reader import Shard
from navrep_data.shards.recipe import ShardRecipe, read_recipe
from navrep_data.shards.statistics import merge_statistics
from navrep_data.shards.verify import Problem, VerifyReport, check_file, verify
from navrep_data.shards.worlds import WORLD_FIELDS, EpisodeWorld, Worlds, read_worlds, take_episodes
from navrep_data.shards.writer import MAX_SHARD_BYTES, ShardImage, ShardWriter, publish, sequence_hash

__all__ = [
    "CARD_FILE",
    "FILE_NAME",
    "INDEX_FILE",
    "LOCK_FILE",
    "MANIFEST_FILE",
    "MAX_SHARD_BYTES",
    "ORIGIN_FILE",
    "SPLITS",
    "SPLIT_RULE",
    "WORLD_FIELDS",
    "DatasetFolder",
    "DatasetWriter",
    "EpisodeWorld",
    "Episodes",
    "FileEntry",
    "Manifest",
    "Origin",
    "Problem",
    "Ranges",
    "SequenceSource",
    "Shard",
    "ShardEntry",
    "ShardImage",
    "ShardRecipe",
    "ShardWriter",
    "VerifyReport",
    "Worlds",
    "check_file",
    "choose_shards",
    "chunk_rows",
    "column_order",
    "content_hash",
    "count_in_split",
    "count_of",
    "dataset_card",
    "dataset_record",
    "estimate_bytes",
    "info",
    "merge_statistics",
    "nth_of_split",
    "numbers_of",
    "publish",
    "ranges_of",
    "read_origin",
    "read_recipe",
    "read_worlds",
    "select_shards",
    "sequence_hash",
    "shard_file",
    "split_of",
    "take_episodes",
    "verify",
    "worlds_file",
    "writer_lock",
]
