"""Load windows of a dataset through a torch DataLoader, as for training M.

python examples/load_windows.py data/demo
"""

import argparse
import time

from torch.utils.data import DataLoader

from navrep_data.datasets import SequenceDataset


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", nargs="?", default="data/demo", help="dataset folder")
    parser.add_argument("--lidar", default="rings", choices=["rings", "1d"])
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--workers", type=int, default=0)
    arguments = parser.parse_args()

    dataset = SequenceDataset(arguments.root, lidar=arguments.lidar, window=32, split="train")
    loader = DataLoader(dataset, batch_size=arguments.batch_size, shuffle=True, num_workers=arguments.workers)
    batch = next(iter(loader))
    print(f"{len(dataset)} windows of 32 rows; a batch of {arguments.batch_size}:")
    for name, tensor in batch.items():
        print(f"  {name:14s} {tuple(tensor.shape)!s:22s} {tensor.dtype}")
    started, windows = time.perf_counter(), 0
    for batch in loader:
        windows += len(batch["mask"])
    print(f"one epoch: {windows / (time.perf_counter() - started):,.0f} windows/s")


if __name__ == "__main__":
    main()
