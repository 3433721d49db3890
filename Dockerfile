# docker build -t zstate .                              the command line, with the robots of models/
# docker build -t zstate --build-arg EXTRAS=robots .    also the robots of example-robot-data (440 MB)
# docker build --target test .                          runs the tests
# docker run --rm --network host zstate tf panda_link0 panda_hand

FROM python:3.12-slim AS build
# The buffer's C extension is built if there is a compiler.
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
# The exact versions with which the gate tests; pip reads the variables.
COPY .ci/constraints.txt /wheels/
ENV PIP_CONSTRAINT=/wheels/constraints.txt PIP_BUILD_CONSTRAINT=/wheels/constraints.txt
WORKDIR /src
COPY pyproject.toml setup.py README.md LICENSE ./
COPY zstate zstate
COPY models models
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM build AS test
COPY . .
RUN python3 -m venv .venv && .venv/bin/pip install -q -e '.[robots,test]' && .venv/bin/python -m pytest -n auto

FROM python:3.12-slim AS runtime
# Pinocchio's wheel needs the system's OpenMP, which slim images lack (gcc installs it in the other stages).
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
ARG EXTRAS=""
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir --constraint /wheels/constraints.txt \
  "$(echo /wheels/zstate-*.whl)${EXTRAS:+[$EXTRAS]}"
RUN useradd --create-home zstate
USER zstate
WORKDIR /home/zstate
ENTRYPOINT ["zstate"]
CMD ["--help"]
