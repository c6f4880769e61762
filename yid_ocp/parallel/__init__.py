"""Parallel work: threads, processes and cluster clients, which no other package starts."""

from yid_ocp.parallel.lockstep import ask_together as ask_together
from yid_ocp.parallel.lockstep import map_in_step as map_in_step
from yid_ocp.parallel.processes import ThisProcess as ThisProcess
from yid_ocp.parallel.processes import process_pool as process_pool
from yid_ocp.parallel.tasks import LOCAL as LOCAL
from yid_ocp.parallel.tasks import Progress as Progress
from yid_ocp.parallel.tasks import Task as Task
from yid_ocp.parallel.tasks import TaskResult as TaskResult
from yid_ocp.parallel.tasks import Workers as Workers
from yid_ocp.parallel.tasks import run_tasks as run_tasks
from yid_ocp.parallel.tasks import values_of as values_of
from yid_ocp.parallel.threads import SYMBOLIC as SYMBOLIC
from yid_ocp.parallel.threads import Once as Once
from yid_ocp.parallel.threads import map_threads as map_threads
from yid_ocp.parallel.threads import processors as processors
