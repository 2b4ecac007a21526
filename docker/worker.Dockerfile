# The worker: claims jobs, trains, serves renders. CPU by default; a CUDA build of torch with
#   docker build --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 …
FROM python:3.12-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

WORKDIR /app
COPY pyproject.toml constraints.txt README.md LICENSE ./
# torch first and alone: it is most of the download, and its layer outlives every change of ours.
RUN pip install --no-cache-dir --constraint constraints.txt --index-url "$TORCH_INDEX" torch
COPY contract contract
COPY worker worker
RUN pip install --no-cache-dir --constraint constraints.txt .

RUN useradd --uid 10001 --create-home intrasplat \
    && install --directory --owner intrasplat --group intrasplat --mode 0700 /data
USER intrasplat
VOLUME /data
# Compiled kernels are kept on the volume, so that a new container does not compile them again.
ENV INTRASPLAT_DATA_DIR=/data \
    INTRASPLAT_CACHE=/data/cache \
    PYTHONUNBUFFERED=1

CMD ["python", "-m", "worker", "consume"]
