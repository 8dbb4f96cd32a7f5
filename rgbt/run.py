"""Train one configuration: ``python -m rgbt.run +experiment=grbm``."""

from omegaconf import DictConfig

from rgbt.command import command


@command()
def main(config: DictConfig) -> int:
    print(config.seed)
    return 0


if __name__ == "__main__":
    main()
