"""Trains a toy policy on the scenes of a run: from the size of an object to its pose.

python -m examples.train_policy RUN
"""

import sys

import torch

import stable_data as sd


def main(run: str, epochs: int = 2) -> None:
    """Prints the loss after each epoch.

    Args:
        run: A run folder or its URI.
        epochs: How often every scene is used.
    """
    scenes = sd.TableStream(run, batch_size=32, collate=sd.collate_scenes, shuffle_seed=0)
    loader = torch.utils.data.DataLoader(scenes, batch_size=None)  # num_workers=2 gives the same batches
    policy = torch.nn.Linear(3, 4)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.01)
    for epoch in range(epochs):
        scenes.set_epoch(epoch)
        for batch in loader:
            error = policy(batch["size"]) - batch["poses"]  # (S, N, 4): x, y, z in metres, yaw in radians
            loss = error[batch["mask"]].square().mean()  # the mask (S, N) leaves out the padding
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        print(f"epoch {epoch}: loss {loss.item():.4f}")


if __name__ == "__main__":
    main(sys.argv[1])
