"""A naive implementation of sections 5.1 and 5.2 of Kameda's paper, as a reference for tests.

It follows the paper's text with boolean images (views, H, W) instead of spans and prefix sums.
"""

import itertools

import numpy as np


class NaiveSearch:
    """``maker``: draws the body. ``masks``: the silhouettes of its first cameras."""

    def __init__(self, maker, masks, r, K):
        self.maker, self.tree, self.values = maker, maker.tree, maker.body.sampled.values
        self.S, self.r, self.K = np.array(masks), r, K
        self.lists, self.u = {}, {}
        self.runs = 0
        self.first_J = None
        self.best = None

    def picture(self, i, t):
        """Return P_i at sample t, with the candidates adopted for the other nodes."""
        full = [grid[0] for grid in self.values]
        for k, adopted in self.u.items():
            full[k] = self.values[k][self.lists[k][adopted]]
        full[i] = self.values[i][t]
        return self.maker.draw_node(i, full, len(self.S))

    def union(self, nodes):
        result = np.zeros_like(self.S)
        for i in nodes:
            result |= self.picture(i, self.lists[i][self.u[i]])
        return result

    def J(self):
        return int((self.union(self.u) ^ self.S).sum())

    def run(self):
        while self.section_5_1():
            self.note()
            self.section_5_2_1()
            if not self.section_5_2_2():
                break
        return self

    def note(self):
        J = self.J()
        if self.first_J is None:
            self.first_J = J
        if self.best is None or J < self.best[0]:
            self.best = J, {i: self.values[i][self.lists[i][t]] for i, t in self.u.items()}

    def section_5_1(self):
        nodes = self.tree.nodes
        while len(self.u) < len(nodes):
            ready = [
                i for i in range(len(nodes))
                if i not in self.u and (nodes[i].parent < 0 or nodes[i].parent in self.u)
            ]  # fmt: skip
            i = min(ready, key=lambda k: nodes[k].depth)
            self.runs += 1
            open_part = self.S & ~self.union(self.u)
            scored = []
            samples = range(len(self.values[i]))
            if self.tree.source(i) != i:
                # The joints mimic the parent's.
                samples = [self.lists[nodes[i].parent][self.u[nodes[i].parent]]]
            for t in samples:
                P = self.picture(i, t)
                if ((P & ~self.S).sum(axis=(1, 2)) <= self.r).all():
                    scored.append((-int((open_part & P).sum()), t))
            scored.sort()
            if scored:
                self.lists[i] = [t for _, t in scored[: self.K]]
                self.u[i] = 0
                continue
            j = nodes[i].parent
            while j >= 0 and self.u[j] + 1 >= len(self.lists[j]):
                j = nodes[j].parent
            if j < 0:
                return False
            self.change(j, self.u[j] + 1)
        return True

    def change(self, j, t):
        self.u[j] = t
        for below in self.tree.subtrees[j][1:]:
            self.u.pop(below, None)

    def section_5_2_1(self):
        leaves = self.tree.leaves
        before = dict(self.u)
        best = self.J(), before
        for combination in itertools.product(*(range(len(self.lists[i])) for i in leaves)):
            self.u = before | dict(zip(leaves, combination, strict=True))
            if best[0] > self.J():
                best = self.J(), dict(self.u)
        self.u = best[1]
        self.note()

    def section_5_2_2(self):
        nodes = self.tree.nodes
        A = [
            i for i in range(len(nodes))
            if nodes[i].children and self.u[i] + 1 < len(self.lists[i])
        ]  # fmt: skip
        while A:
            covers = []
            for i in A:
                R = self.S & ~self.union([k for k in self.u if k != i])
                for t in range(self.u[i], len(self.lists[i])):
                    P = self.picture(i, self.lists[i][t])
                    covers.append((-int((R & P).sum()), i, t))
            _, m, t_m = min(covers)
            if t_m > self.u[m]:
                self.change(m, t_m)
                return True
            A.remove(m)
        return False
