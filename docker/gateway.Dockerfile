# The gateway service alone: only its own code and shared/ are in the image.
#   docker build -f docker/gateway.Dockerfile -t pointslam/gateway .
FROM python:3.11-slim

ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OMP_WAIT_POLICY=passive MALLOC_ARENA_MAX=2 \
    PYTHONUNBUFFERED=1
WORKDIR /app
COPY pyproject.toml README.md requirements.lock ./
COPY shared/ shared/
COPY services/__init__.py services/__init__.py
COPY services/gateway/ services/gateway/
COPY pointslam/__init__.py pointslam/keys.py pointslam/
RUN pip install --no-cache-dir -c requirements.lock ".[gateway]" \
    && useradd --create-home --uid 10001 pointslam \
    && mkdir -p /data /keys && chown pointslam /data /keys /app
USER pointslam
EXPOSE 8080 50051
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s \
    CMD ["python", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8080/readyz', timeout=4)"]
ENTRYPOINT ["python", "-m", "services.gateway"]
