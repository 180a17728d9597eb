// F01 to F04: rays against boxes. Geometry is float64 throughout, so these cases have that row alone.
#include <algorithm>
#include <cstdlib>

#include "core/rng.h"
#include "core/small_math.h"
#include "eval/evaluator.h"
#include "named_case.h"

namespace semfield::numerics {

namespace {

const Box kBox{{-1, -2, 0.5}, {3, 1, 2}};

double number(std::uint64_t index) {
  return static_cast<double>(uniform01({7, 0, stream_id("stiff geometry")}, index));
}

// Where a ray that starts in the closed box leaves it.
long double exit_of(const Box& box, Vec3d o, Vec3d d) {
  long double nearest = 1e300L;
  for (int i = 0; i < 3; ++i) {
    if (d[i] == 0) continue;
    const long double face = d[i] > 0 ? box.hi[i] : box.lo[i];
    nearest = std::min(nearest, (face - o[i]) / static_cast<long double>(d[i]));
  }
  return nearest;
}

// A camera at `o` whose only pixel looks along the unit axis d exactly.
RayCamera looking_along(Vec3d o, int axis, double sign) {
  RayCamera camera{.camera = {.width_px = 1, .height_px = 1, .fx = 1, .fy = 1, .cx = 0.5, .cy = 0.5}};
  Vec3d columns[3];
  columns[2][axis] = sign;
  columns[0][(axis + 1) % 3] = 1;
  columns[1] = cross(columns[2], columns[0]);
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) camera.world_from_camera.r[row][col] = columns[col][row];
  }
  camera.world_from_camera.t = o;
  return camera;
}

RayLimits limits_of(const Box& box) { return RayLimits{.near_m = 0, .far_m = 1e9, .clip = true, .bounds = box}; }

}  // namespace

void box_on_face(CaseRun& run) {
  run.row("float64");
  int rays = 0;
  for (std::uint64_t n = 0; n < 3000; ++n) {
    // Bits of n choose the axes whose coordinate lies on a face (at least one), and on which.
    const unsigned on = 1 + static_cast<unsigned>(n % 7);
    Vec3d o, d;
    for (int i = 0; i < 3; ++i) {
      const bool upper = (n >> (4 + i) & 1) != 0;
      o[i] = kBox.lo[i] + (kBox.hi[i] - kBox.lo[i]) * (0.1 + 0.8 * number(8 * n + static_cast<unsigned>(i)));
      d[i] = 2 * number(8 * n + 3 + static_cast<unsigned>(i)) - 1;
      if ((on >> i & 1) == 0) continue;
      o[i] = upper ? kBox.hi[i] : kBox.lo[i];
      const unsigned kind = static_cast<unsigned>(n >> 7) % 4;  // along the face, -0, tiny, or inwards
      d[i] = kind == 0   ? 0.0
             : kind == 1 ? -0.0
             : kind == 2 ? (upper ? -1e-310 : 1e-310)
                         : (upper ? -1 : 1) * std::abs(d[i]);
    }
    if (d == Vec3d{0, 0, 0}) continue;
    double t_near = -1, t_far = -1;
    run.expect(intersect(kBox, o, d, t_near, t_far), "a ray that starts on a face and does not leave meets the box");
    run.measure(std::abs(t_near), 0, "t_near");
    const long double exit = std::min(exit_of(kBox, o, d), 1e300L);
    run.measure(relative_error(t_far, exit), 3e-16, "t_far");  // one subtraction, one division
    ++rays;
  }
  // The same through a camera: directions along an axis are exact.
  for (int axis = 0; axis < 3; ++axis) {
    for (const double sign : {1.0, -1.0}) {
      Vec3d o = kBox.center();
      o[(axis + 1) % 3] = kBox.hi[(axis + 1) % 3];
      double origin[3], direction[3], near_far[2];
      cast_ray(looking_along(o, axis, sign), limits_of(kBox), 0, 0, origin, direction, near_far);
      run.measure(std::abs(near_far[1] - 0.5 * kBox.size()[axis]), 0, "length of a ray in a face");
      run.measure(std::abs(near_far[0]), 0, "its near end");
    }
  }
  run.note(std::to_string(rays) + " rays from faces, edges and corners");
}

void box_parallel_outside(CaseRun& run) {
  run.row("float64");
  for (int axis = 0; axis < 3; ++axis) {
    for (const bool upper : {false, true}) {
      const double face = upper ? kBox.hi[axis] : kBox.lo[axis];
      const double away = upper ? 1e300 : -1e300;
      for (const double place : {std::nextafter(face, away), face + (upper ? 1e-9 : -1e-9), face + (upper ? 1 : -1),
                                 face + (upper ? 1e6 : -1e6)}) {
        for (const double zero : {0.0, -0.0}) {
          for (std::uint64_t n = 0; n < 20; ++n) {
            Vec3d o = kBox.center(), d{2 * number(3 * n) - 1, 2 * number(3 * n + 1) - 1, 2 * number(3 * n + 2) - 1};
            o[axis] = place;
            d[axis] = zero;
            double t_near = 0, t_far = 0;
            run.expect(!intersect(kBox, o, d, t_near, t_far), "a ray beside the slab misses");
          }
        }
        Vec3d o = kBox.center();
        o[axis] = place;
        double origin[3], direction[3], near_far[2] = {1, 1};
        cast_ray(looking_along(o, (axis + 1) % 3, 1), limits_of(kBox), 0, 0, origin, direction, near_far);
        run.expect(near_far[0] == 0 && near_far[1] == 0, "its interval is empty");
      }
    }
  }
}

void box_every_place(CaseRun& run) {
  run.row("float64");
  const Box box{{-1, -1, -1}, {1, 1, 1}};
  struct Ratio {
    std::int64_t over = 0, under = 1;  // under > 0
    bool below(const Ratio& o) const { return over * o.under < o.over * under; }
    double value() const { return static_cast<double>(over) / static_cast<double>(under); }
  };
  int hits = 0, misses = 0;
  for (int place = 0; place < 125; ++place) {
    const std::array<int, 3> o{place % 5 - 2, place / 5 % 5 - 2, place / 25 - 2};
    for (int turn = 0; turn < 54; ++turn) {
      // Signs -1, 0, 1 per axis; the second half has components of 1, 2 and 3.
      const int signs = turn % 27, spread = turn / 27;
      const std::array<int, 3> d{signs % 3 - 1, (signs / 3 % 3 - 1) * (1 + spread), (signs / 9 - 1) * (1 + 2 * spread)};
      if (d == std::array<int, 3>{}) continue;
      bool expected = true;
      Ratio enter{0, 1}, leave{1'000'000, 1};
      for (std::size_t i = 0; i < 3; ++i) {
        if (d[i] == 0) {
          expected = expected && o[i] >= -1 && o[i] <= 1;
          continue;
        }
        const int s = d[i] > 0 ? 1 : -1;
        const Ratio in{(-s - o[i]) * s, std::abs(d[i])}, out{(s - o[i]) * s, std::abs(d[i])};
        if (enter.below(in)) enter = in;
        if (out.below(leave)) leave = out;
      }
      expected = expected && !leave.below(enter);
      double t_near = 0, t_far = 0;
      const bool hit = intersect(box, {double(o[0]), double(o[1]), double(o[2])},
                                 {double(d[0]), double(d[1]), double(d[2])}, t_near, t_far);
      run.expect(hit == expected, "hit or miss as rational numbers tell");
      (expected ? hits : misses) += 1;
      if (!hit || !expected) continue;
      run.measure(std::abs(t_near - enter.value()), 0, "t_near");
      run.measure(std::abs(t_far - leave.value()), 0, "t_far");
    }
  }
  run.note(std::to_string(hits) + " hits, " + std::to_string(misses) + " misses, every one as expected");
}

void box_thin(CaseRun& run) {
  run.row("float64");
  for (unsigned flat = 1; flat < 8; ++flat) {
    Box box{{-1, -1, -1}, {1, 1, 1}};
    for (int i = 0; i < 3; ++i) {
      if ((flat >> i & 1) != 0) box.lo[i] = box.hi[i] = 0.25;
    }
    for (int axis = 0; axis < 3; ++axis) {
      const bool across = (flat >> axis & 1) != 0;
      Vec3d o{0.25, 0.25, 0.25}, d;
      o[axis] = -3;
      d[axis] = 1;
      double t_near = 0, t_far = 0;
      run.expect(intersect(box, o, d, t_near, t_far), "a ray through the middle meets it");
      run.measure(std::abs(t_far - t_near - (across ? 0 : 2)), 0, "length inside");
      double origin[3], direction[3], near_far[2] = {1, 1};
      cast_ray(looking_along(o, axis, 1), limits_of(box), 0, 0, origin, direction, near_far);
      run.expect(across ? near_far[0] == 0 && near_far[1] == 0 : near_far[1] - near_far[0] == 2,
                 "a ray without length inside is an empty ray");
      Vec3d beside = o;
      beside[(axis + 1) % 3] = 1.5;
      run.expect(!intersect(box, beside, d, t_near, t_far), "a ray beside it misses");
    }
    double t_near = 0, t_far = 0;
    run.expect(intersect(box, {-0.75, -0.75, -0.75}, {1, 1, 1}, t_near, t_far), "a diagonal ray meets it");
    run.measure(std::abs(t_near - 1), 0, "its distance");
    run.measure(std::abs(t_far - 1), 0, "where it leaves");
  }
}

}  // namespace semfield::numerics
