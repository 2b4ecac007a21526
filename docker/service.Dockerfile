# The HTTP service and its page for the browser. No torch: it parses, asks and returns.
ARG BASE=python:3.12.13-slim-trixie

FROM ${BASE} AS build
WORKDIR /app
RUN python -m venv /venv
COPY pyproject.toml constraints.txt README.md LICENSE ./
# The project's own requirements are the worker's too (torch, OpenCV); the service needs these alone.
RUN /venv/bin/pip install --no-cache-dir --constraint constraints.txt \
        fastapi starlette anyio uvicorn websockets h11 pydantic redis pyzmq python-multipart httpx prometheus-client fsspec s3fs \
        opentelemetry-api opentelemetry-sdk opentelemetry-exporter-otlp-proto-http
COPY contract contract
COPY service service
COPY client client
RUN /venv/bin/pip install --no-cache-dir --no-deps .

FROM ${BASE}
RUN useradd --uid 10001 --no-create-home intrasplat \
    && install --directory --owner intrasplat --group intrasplat --mode 0700 /data
COPY --from=build /venv /venv
COPY client/dashboard /app/dashboard
COPY docker/health.py /app/health.py
USER 10001:10001
WORKDIR /app
VOLUME /data
ENV PATH=/venv/bin:$PATH \
    HOME=/tmp \
    INTRASPLAT_DASHBOARD_DIR=/app/dashboard \
    INTRASPLAT_DATA_DIR=/data \
    INTRASPLAT_HOST=0.0.0.0 \
    INTRASPLAT_LOG_FORMAT=json \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1
EXPOSE 8765
HEALTHCHECK --interval=5s --timeout=4s --start-period=30s --retries=3 CMD ["python", "/app/health.py", "service"]
CMD ["python", "-m", "service"]
