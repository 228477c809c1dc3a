"""ORCA the slow way: plain Python over float32 pairs, with linked edges and a tree that is really walked.

Shares nothing with the kernels: objects instead of arrays, recursion instead of stacks, branches instead of
selects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

EPSILON = np.float32(1e-5)
f32 = np.float32


class V:
    """A float32 vector; ``*`` is the dot product or a scaling, ``@`` the determinant."""

    __slots__ = ("x", "y")

    def __init__(self, x, y):
        self.x, self.y = f32(x), f32(y)

    def __add__(self, o):
        return V(self.x + o.x, self.y + o.y)

    def __sub__(self, o):
        return V(self.x - o.x, self.y - o.y)

    def __neg__(self):
        return V(-self.x, -self.y)

    def __mul__(self, o):
        return self.x * o.x + self.y * o.y if isinstance(o, V) else V(self.x * o, self.y * o)

    def __truediv__(self, scalar):
        inverse = f32(1) / scalar
        return V(self.x * inverse, self.y * inverse)

    def __matmul__(self, o):
        return self.x * o.y - self.y * o.x

    def unit(self):
        return self / np.sqrt(self * self)

    def left(self):
        return V(-self.y, self.x)

    def right(self):
        return V(self.y, -self.x)


def left_of(a, b, c):
    return (a - c) @ (b - a)


@dataclass(eq=False)
class Edge:
    point: V
    direction: V
    convex: bool
    next: Edge | None = None
    prev: Edge | None = None


@dataclass
class Node:
    edge: Edge
    left: Node | None
    right: Node | None


def make_edges(polygons):
    edges = []
    for polygon in polygons:
        points = [V(*p) for p in polygon]
        n = len(points)
        loop = []
        for k, p in enumerate(points):
            after = points[(k + 1) % n]
            convex = n == 2 or bool(left_of(points[k - 1], p, after) >= 0)
            loop.append(Edge(p, (after - p).unit(), convex))
        for k, edge in enumerate(loop):
            edge.next, edge.prev = loop[(k + 1) % n], loop[k - 1]
        edges += loop
    return edges


def _where(chosen, edge):
    a, b = chosen.point, chosen.next.point
    s1, s2 = left_of(a, b, edge.point), left_of(a, b, edge.next.point)
    if s1 >= -EPSILON and s2 >= -EPSILON:
        return "left", s1
    if s1 <= EPSILON and s2 <= EPSILON:
        return "right", s1
    return "both", s1


def build_tree(edges, everything):
    """Build the tree; edges that are cut put their new halves at the end of `everything`."""
    if not edges:
        return None
    scores = []
    for k, chosen in enumerate(edges):
        sides = [_where(chosen, e)[0] for e in edges if e is not chosen]
        left = sum(s != "right" for s in sides)
        right = sum(s != "left" for s in sides)
        scores.append((max(left, right), min(left, right), k))
    chosen = edges[min(scores)[2]]
    left, right = [], []
    for e in edges:
        if e is chosen:
            continue
        side, s1 = _where(chosen, e)
        if side == "left":
            left.append(e)
        elif side == "right":
            right.append(e)
        else:
            a, line, end = chosen.point, chosen.next.point - chosen.point, e.next
            t = (line @ (e.point - a)) / (line @ (e.point - end.point))
            cut = Edge(e.point + (end.point - e.point) * t, e.direction, True, end, e)
            e.next = end.prev = cut
            everything.append(cut)
            (left if s1 > 0 else right).append(e)
            (right if s1 > 0 else left).append(cut)
    return Node(chosen, build_tree(left, everything), build_tree(right, everything))


def edge_distance_sq(p, edge):
    a, b = edge.point, edge.next.point
    r = ((p - a) * (b - a)) / ((b - a) * (b - a))
    nearest = a if r < 0 else b if r > 1 else a + (b - a) * r
    return (p - nearest) * (p - nearest)


def walk(node, p, range_sq, found):
    """Walk RVO2's tree; `found` collects (squared distance, edge), nearest first, equal ones as they come."""
    if node is None:
        return
    edge = node.edge
    a, b = edge.point, edge.next.point
    left = left_of(a, b, p)
    near, far = (node.left, node.right) if left >= 0 else (node.right, node.left)
    walk(near, p, range_sq, found)
    if left * left / ((b - a) * (b - a)) < range_sq:
        if left < 0:
            _insert(found, edge_distance_sq(p, edge), edge, range_sq)
        walk(far, p, range_sq, found)


def _insert(found, d, item, range_sq):
    if d < range_sq:
        at = len(found)
        while at and d < found[at - 1][0]:
            at -= 1
        found.insert(at, (d, item))


def agent_neighbors(i, position, neighbor_dist, most):
    ranked = []
    for j, other in enumerate(position):
        if j != i:
            d = (position[i] - other) * (position[i] - other)
            if d < neighbor_dist * neighbor_dist:
                ranked.append((d, j))
    return [j for _, j in sorted(ranked)[:most]]


def obstacle_line(o1, p, v, radius, inv_tau, lines):
    """Return the (point, direction) of one edge, or None."""
    o2 = o1.next
    r1, r2 = o1.point - p, o2.point - p
    for point, direction in lines:
        if all((r * inv_tau - point) @ direction - inv_tau * radius >= -EPSILON for r in (r1, r2)):
            return None
    d1, d2, rr = r1 * r1, r2 * r2, radius * radius
    span = o2.point - o1.point
    s = (-r1 * span) / (span * span)
    off = -r1 - span * s
    d_line = off * off
    zero = V(0, 0)
    if s < 0 and d1 <= rr:
        return (zero, r1.left().unit()) if o1.convex else None
    if s > 1 and d2 <= rr:
        return (zero, r2.left().unit()) if o2.convex and r2 @ o2.direction >= 0 else None
    if 0 <= s <= 1 and d_line <= rr:
        return zero, -o1.direction

    def tangents(r, d):
        leg = np.sqrt(d - rr)
        return (
            V(r.x * leg - r.y * radius, r.x * radius + r.y * leg) / d,
            V(r.x * leg + r.y * radius, -r.x * radius + r.y * leg) / d,
        )

    if s < 0 and d_line <= rr:
        if not o1.convex:
            return None
        o2 = o1
        left, right = tangents(r1, d1)
    elif s > 1 and d_line <= rr:
        if not o2.convex:
            return None
        o1 = o2
        left, right = tangents(r2, d2)
    else:
        left = tangents(r1, d1)[0] if o1.convex else -o1.direction
        right = tangents(r2, d2)[1] if o2.convex else o1.direction
    left_foreign = right_foreign = False
    if o1.convex and left @ -o1.prev.direction >= 0:
        left, left_foreign = -o1.prev.direction, True
    if o2.convex and right @ o2.direction <= 0:
        right, right_foreign = o2.direction, True

    c1, c2 = (o1.point - p) * inv_tau, (o2.point - p) * inv_tau
    cut = c2 - c1
    rt = radius * inv_tau
    t = f32(0.5) if o1 is o2 else ((v - c1) * cut) / (cut * cut)
    t1, t2 = (v - c1) * left, (v - c2) * right
    if (t < 0 and t1 < 0) or (o1 is o2 and t1 < 0 and t2 < 0):
        w = (v - c1).unit()
        return c1 + w * rt, w.right()
    if t > 1 and t2 < 0:
        w = (v - c2).unit()
        return c2 + w * rt, w.right()

    def gap(q):
        return (v - q) * (v - q)

    d_cut = math.inf if t < 0 or t > 1 or o1 is o2 else gap(c1 + cut * t)
    d_left = math.inf if t1 < 0 else gap(c1 + left * t1)
    d_right = math.inf if t2 < 0 else gap(c2 + right * t2)
    if d_cut <= d_left and d_cut <= d_right:
        return c1 + (-o1.direction).left() * rt, -o1.direction
    if d_left <= d_right:
        return None if left_foreign else (c1 + left.left() * rt, left)
    return None if right_foreign else (c2 + (-right).left() * rt, -right)


def agent_line(p, v, radius, other_p, other_v, other_radius, inv_tau, inv_dt):
    r, rv = other_p - p, v - other_v
    d, both = r * r, radius + other_radius
    if d > both * both:
        w = rv - r * inv_tau
        dot = w * r
        if dot < 0 and dot * dot > both * both * (w * w):
            length = np.sqrt(w * w)
            unit = w / length
            return v + unit * (both * inv_tau - length) * f32(0.5), unit.right()
        leg = np.sqrt(d - both * both)
        if r @ w > 0:
            direction = V(r.x * leg - r.y * both, r.x * both + r.y * leg) / d
        else:
            direction = -V(r.x * leg + r.y * both, -r.x * both + r.y * leg) / d
        return v + (direction * (rv * direction) - rv) * f32(0.5), direction
    w = rv - r * inv_dt
    length = np.sqrt(w * w)
    unit = w / length
    return v + unit * (both * inv_dt - length) * f32(0.5), unit.right()


def program1(lines, k, radius, target, along):
    point, direction = lines[k]
    dot = point * direction
    disc = dot * dot + radius * radius - point * point
    if disc < 0:
        return None
    low, high = -dot - np.sqrt(disc), -dot + np.sqrt(disc)
    for other_point, other_direction in lines[:k]:
        den = direction @ other_direction
        num = other_direction @ (point - other_point)
        if abs(den) <= EPSILON:
            if num < 0:
                return None
            continue
        t = num / den
        if den >= 0:
            high = t if t < high else high
        else:
            low = t if low < t else low
        if low > high:
            return None
    if along:
        t = high if target * direction > 0 else low
    else:
        t = direction * (target - point)
        t = low if t < low else high if t > high else t
    return point + direction * t


def program2(lines, radius, target, along):
    if along:
        best = target * radius
    else:
        best = target.unit() * radius if target * target > radius * radius else target
    for k, (point, direction) in enumerate(lines):
        if direction @ (point - best) > 0:
            better = program1(lines, k, radius, target, along)
            if better is None:
                return k, best
            best = better
    return len(lines), best


def program3(lines, n_obstacle, begin, radius, best):
    distance = f32(0)
    for i in range(begin, len(lines)):
        point, direction = lines[i]
        if not direction @ (point - best) > distance:
            continue
        projected = lines[:n_obstacle]
        for other_point, other_direction in lines[n_obstacle:i]:
            den = direction @ other_direction
            if abs(den) <= EPSILON:
                if direction * other_direction > 0:
                    continue
                start = (point + other_point) * f32(0.5)
            else:
                start = point + direction * ((other_direction @ (point - other_point)) / den)
            projected.append((start, (other_direction - direction).unit()))
        failed, better = program2(projected, radius, direction.left(), True)
        if failed == len(projected):
            best = better
        distance = direction @ (point - best)
    return best


def orca_velocities(positions, velocities, radii, max_speeds, preferred, polygons=(), settings=(10, 10, 5, 5, 0.2)):
    """Return (N, 2) float32 new velocities; `settings` as in RVO2: distance, number, horizons, time step."""
    neighbor_dist, most, tau, tau_obst, dt = settings
    with np.errstate(all="ignore"):
        everything = make_edges(polygons)
        tree = build_tree(list(everything), everything)
        position = [V(*p) for p in positions]
        out = []
        for i, p in enumerate(position):
            v, radius, speed = V(*velocities[i]), f32(radii[i]), f32(max_speeds[i])
            found: list[tuple[np.float32, Edge]] = []
            reach = f32(tau_obst) * speed + radius
            walk(tree, p, reach * reach, found)
            lines = []
            for _, edge in found:
                line = obstacle_line(edge, p, v, radius, f32(1) / f32(tau_obst), lines)
                if line is not None:
                    lines.append(line)
            n_obstacle = len(lines)
            for j in agent_neighbors(i, position, f32(neighbor_dist), most):
                lines.append(
                    agent_line(
                        p, v, radius, position[j], V(*velocities[j]), f32(radii[j]),
                        f32(1) / f32(tau), f32(1) / f32(dt),
                    )
                )  # fmt: skip
            failed, best = program2(lines, speed, V(*preferred[i]), False)
            if failed < len(lines):
                best = program3(lines, n_obstacle, failed, speed, best)
            out.append((best.x, best.y))
        return np.array(out, np.float32).reshape(-1, 2)
