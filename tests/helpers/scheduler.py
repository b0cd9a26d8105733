"""An executor whose work is done when a test says so, instead of a thread."""

from concurrent.futures import Executor, Future


class Job(Future):
    """Work that was handed over; asking for its result before it is done does it."""

    def __init__(self, work):
        super().__init__()
        self._work = work

    def run(self):
        """Do it now, in the caller's thread."""
        try:
            self.set_result(self._work())
        except BaseException as error:
            self.set_exception(error)

    def result(self, timeout=None):
        """What came out."""
        if not self.done():
            self.run()
        return super().result(timeout)


class Scheduler(Executor):
    """Keeps what is submitted until `work`; with ``at_once`` it is done when it is submitted."""

    def __init__(self, at_once=False):
        self.at_once = at_once
        self.jobs = []
        self.is_shut = False

    def submit(self, fn, /, *args, **kwargs):
        """Keep a call for later."""
        assert not self.is_shut
        job = Job(lambda: fn(*args, **kwargs))
        self.jobs.append(job)
        if self.at_once:
            job.run()
        return job

    @property
    def waiting(self):
        """What is not done yet."""
        return [job for job in self.jobs if not job.done()]

    def work(self):
        """Do all that waits."""
        for job in self.waiting:
            job.run()

    def shutdown(self, wait=True, *, cancel_futures=False):
        """No more work."""
        self.is_shut = True
