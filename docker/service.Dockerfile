# The HTTP service and its page for the browser. No torch: it parses, asks and returns.
FROM python:3.12-slim

WORKDIR /app
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY contract contract
COPY service service
COPY client client
# The project's own requirements are the worker's too (torch, OpenCV); the service needs these alone.
RUN pip install --no-cache-dir --constraint constraints.txt \
        fastapi starlette uvicorn pydantic redis pyzmq python-multipart httpx \
    && pip install --no-cache-dir --no-deps .

RUN useradd --uid 10001 --no-create-home intrasplat \
    && install --directory --owner intrasplat --group intrasplat --mode 0700 /data
USER intrasplat
VOLUME /data
ENV INTRASPLAT_DATA_DIR=/data \
    INTRASPLAT_DASHBOARD_DIR=/app/client/dashboard \
    PYTHONUNBUFFERED=1

CMD ["python", "-m", "service"]
