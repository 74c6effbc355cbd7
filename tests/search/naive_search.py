"""A naive implementation of sections 5.1 and 5.2 of Kameda's paper, as a reference for tests.

It follows the paper's text with boolean images instead of spans and prefix sums, in one view.
"""

import itertools

import numpy as np

from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.scoring import draw_mask


class NaiveSearch:
    def __init__(self, search, camera, silhouette, r, K):
        self.tree = search.tree
        self.values = search.sampled.values
        self.surfaces = TreeSurfaces(search.tree)
        self.camera, self.S, self.r, self.K = camera, silhouette, r, K
        self.lists, self.u = {}, {}
        self.runs = 0
        self.first_J = None
        self.best = None

    def picture(self, i, values):
        """Return P_i, with the candidates adopted for the other nodes."""
        full = [grid[0] for grid in self.values]
        for k, t in self.u.items():
            full[k] = self.values[k][self.lists[k][t]]
        full[i] = values
        X_CN = self.camera.X_CW @ self.tree.node_poses(full)
        surface = self.surfaces.node_at(i, full[i])
        return draw_mask([surface], X_CN[i : i + 1], self.camera)

    def adopted_picture(self, i):
        return self.picture(i, self.values[i][self.lists[i][self.u[i]]])

    def union(self, nodes):
        result = np.zeros_like(self.S)
        for i in nodes:
            result |= self.adopted_picture(i)
        return result

    def run(self):
        while self.section_5_1():
            self.note()
            self.section_5_2_1()
            if not self.section_5_2_2():
                break
        return self

    def note(self):
        J = int((self.union(self.u) ^ self.S).sum())
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
            for t, values in enumerate(self.values[i]):
                P = self.picture(i, values)
                outside = (P & ~self.S).sum()
                if outside <= self.r:
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
        for k in range(len(self.tree.nodes)):
            ancestor = self.tree.nodes[k].parent
            while ancestor >= 0:
                if ancestor == j:
                    self.u.pop(k, None)
                ancestor = self.tree.nodes[ancestor].parent

    def section_5_2_1(self):
        leaves = [i for i, node in enumerate(self.tree.nodes) if not node.children]
        before = dict(self.u)
        best = int((self.union(self.u) ^ self.S).sum()), before
        for combination in itertools.product(*(range(len(self.lists[i])) for i in leaves)):
            self.u = before | dict(zip(leaves, combination, strict=True))
            J = int((self.union(self.u) ^ self.S).sum())
            if best[0] > J:
                best = J, dict(self.u)
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
                    P = self.picture(i, self.values[i][self.lists[i][t]])
                    covers.append((-int((R & P).sum()), i, t))
            _, m, t_m = min(covers)
            if t_m > self.u[m]:
                self.change(m, t_m)
                return True
            A.remove(m)
        return False
