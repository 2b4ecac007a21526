# The worker: claims jobs, trains, serves renders. CPU by default; for NVIDIA GPUs (docker/compose.gpu.yml does this)
#   docker build --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 \
#                --build-arg SYSTEM_PACKAGES="gcc libc6-dev" --build-arg EXTRAS=s3,mesh,onnx,otel,gpu …
ARG BASE=python:3.12.13-slim-trixie

FROM ${BASE} AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG EXTRAS=s3,mesh,onnx,otel
WORKDIR /app
RUN python -m venv /venv
COPY constraints.txt ./
# torch first and alone: it is most of the download, and its layer outlives every change of ours.
# Its index has of everything else the versions it likes; those of constraints.txt come with the next step.
RUN grep -E '^(torch|triton)[<>=]' constraints.txt >torch.txt \
    && /venv/bin/pip install --no-cache-dir --constraint torch.txt --index-url "$TORCH_INDEX" torch
# Then what library and server ask for, which a change of the code does not install anew.
COPY pyproject.toml docker/requirements.py README.md LICENSE ./
COPY service/pyproject.toml service/
RUN python requirements.py "$EXTRAS" >requirements.txt \
    && /venv/bin/pip install --no-cache-dir --constraint constraints.txt --requirement requirements.txt
COPY intrasplat intrasplat
COPY contract contract
COPY worker worker
# the commands of the server
COPY client client
RUN /venv/bin/pip install --no-cache-dir --no-deps . ./client ./service

FROM ${BASE}
# Triton, on a GPU, compiles its launchers with a C compiler; the CPU needs none.
ARG SYSTEM_PACKAGES=""
RUN if [ -n "$SYSTEM_PACKAGES" ]; then \
        apt-get update && apt-get install --yes --no-install-recommends $SYSTEM_PACKAGES \
        && rm -rf /var/lib/apt/lists/*; fi
RUN useradd --uid 10001 --no-create-home intrasplat \
    && install --directory --owner intrasplat --group intrasplat --mode 0700 /data
COPY --from=build /venv /venv
COPY docker/health.py /app/health.py
USER 10001:10001
WORKDIR /app
VOLUME /data
# Compiled kernels are kept on the volume, so that a new container does not compile them again.
ENV PATH=/venv/bin:$PATH \
    HOME=/tmp \
    INTRASPLAT_CACHE=/data/cache \
    INTRASPLAT_DATA_DIR=/data \
    INTRASPLAT_LOG_FORMAT=json \
    TRITON_CACHE_DIR=/data/cache/triton \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1
HEALTHCHECK --interval=5s --timeout=4s --start-period=120s --retries=3 CMD ["python", "/app/health.py", "worker"]
CMD ["python", "-m", "worker", "consume"]
