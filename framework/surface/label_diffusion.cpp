#define EIGEN_DONT_PARALLELIZE
#include "surface/label_diffusion.h"

#include <Eigen/IterativeLinearSolvers>
#include <Eigen/SparseCore>
#include <algorithm>
#include <mutex>
#include <numeric>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"

namespace semfield {

namespace {

using Matrix = Eigen::SparseMatrix<double>;
using Solver = Eigen::ConjugateGradient<Matrix, Eigen::Lower | Eigen::Upper, Eigen::IncompleteCholesky<double>>;

constexpr double kResidual = 1e-6;  // of the right side that votes of weight 1 give
constexpr int kMostIterations = 20000;

// Connected parts: the root of a node is the least node of its part.
class Parts {
 public:
  Parts(std::size_t nodes, std::span<const GraphEdge> edges) : parent_(nodes) {
    std::iota(parent_.begin(), parent_.end(), 0);
    for (const GraphEdge& edge : edges) {
      const std::int32_t a = root(edge.a), b = root(edge.b);
      parent_[static_cast<std::size_t>(std::max(a, b))] = std::min(a, b);
    }
  }
  std::int32_t root(std::int32_t node) {
    while (parent_[static_cast<std::size_t>(node)] != node) {
      std::int32_t& up = parent_[static_cast<std::size_t>(node)];
      up = parent_[static_cast<std::size_t>(up)];
      node = up;
    }
    return node;
  }

 private:
  std::vector<std::int32_t> parent_;
};

// The nodes of parts with votes, and the matrix L + D of them.
struct System {
  std::vector<std::int32_t> node_of_row;
  Matrix matrix;
};

System build_system(std::span<const GraphEdge> edges, std::span<const double> held, std::span<const char> reached) {
  System system;
  std::vector<std::int32_t> row_of_node(reached.size(), -1);
  for (std::size_t n = 0; n < reached.size(); ++n) {
    if (reached[n] == 0) continue;
    row_of_node[n] = static_cast<std::int32_t>(system.node_of_row.size());
    system.node_of_row.push_back(static_cast<std::int32_t>(n));
  }
  std::vector<Eigen::Triplet<double>> entries;
  std::vector<double> diagonal(system.node_of_row.size());
  for (std::size_t row = 0; row < diagonal.size(); ++row)
    diagonal[row] = held[static_cast<std::size_t>(system.node_of_row[row])];
  for (const GraphEdge& edge : edges) {
    const std::int32_t a = row_of_node[static_cast<std::size_t>(edge.a)],
                       b = row_of_node[static_cast<std::size_t>(edge.b)];
    if (a < 0) continue;  // both or none: they are of one part
    entries.emplace_back(a, b, -edge.weight);
    entries.emplace_back(b, a, -edge.weight);
    diagonal[static_cast<std::size_t>(a)] += edge.weight;
    diagonal[static_cast<std::size_t>(b)] += edge.weight;
  }
  const auto rows = static_cast<std::int32_t>(diagonal.size());
  for (std::int32_t row = 0; row < rows; ++row) entries.emplace_back(row, row, diagonal[static_cast<std::size_t>(row)]);
  system.matrix.resize(rows, rows);
  system.matrix.setFromTriplets(entries.begin(), entries.end());
  return system;
}

// Rows become distributions: rounding may leave sums beside 1 and values below 0.
void normalise(std::span<float> row) {
  float sum = 0;
  for (float& value : row) sum += value = std::max(value, 0.0F);
  for (float& value : row) value = sum > 0 ? value / sum : 0;
}

}  // namespace

Diffusion diffuse_votes(std::span<const GraphEdge> edges, std::span<const double> votes, int classes,
                        double vote_weight, const std::function<void(int done, int of)>& done) {
  SEMFIELD_CHECK(classes > 0 && votes.size() % static_cast<std::size_t>(classes) == 0, "a row of votes a node");
  const auto width = static_cast<std::size_t>(classes);
  const std::size_t nodes = votes.size() / width;
  std::vector<double> held(nodes);
  std::vector<char> voted_class(width), reached(nodes), voted_part(nodes);
  Parts parts(nodes, edges);
  for (std::size_t n = 0; n < nodes; ++n) {
    for (std::size_t c = 0; c < width; ++c) {
      const double vote = votes[n * width + c];
      held[n] += vote_weight * vote;
      voted_class[c] |= vote > 0 ? 1 : 0;
    }
    if (held[n] > 0) voted_part[static_cast<std::size_t>(parts.root(static_cast<std::int32_t>(n)))] = 1;
  }
  Diffusion out;
  out.probability.resize(votes.size());
  for (std::size_t n = 0; n < nodes; ++n) {
    const auto root = static_cast<std::size_t>(parts.root(static_cast<std::int32_t>(n)));
    reached[n] = voted_part[root];
    if (root != n) continue;
    ++out.parts;
    out.parts_without_vote += voted_part[n] == 0 ? 1 : 0;
  }
  const System system = build_system(edges, held, reached);
  if (system.node_of_row.empty()) return out;
  std::vector<std::size_t> asked;
  for (std::size_t c = 0; c < width; ++c) {
    if (voted_class[c] != 0) asked.push_back(c);
  }
  std::mutex told;
  int solved = 0;
  // A solver keeps the state of its last solution, so every worker has one; each class is solved alone.
  const std::int64_t workers = std::min<std::int64_t>(thread_count(), std::ssize(asked));
  parallel_for(workers, [&](std::int64_t worker) {
    Solver solver;
    solver.setTolerance(kResidual / std::max(1.0, vote_weight));
    solver.setMaxIterations(kMostIterations);
    solver.compute(system.matrix);
    SEMFIELD_CHECK(solver.info() == Eigen::Success, "a Laplacian with votes is positive definite");
    for (auto k = static_cast<std::size_t>(worker); k < asked.size(); k += static_cast<std::size_t>(workers)) {
      const auto place = [&](Eigen::Index row) {
        return static_cast<std::size_t>(system.node_of_row[static_cast<std::size_t>(row)]) * width + asked[k];
      };
      Eigen::VectorXd right(std::ssize(system.node_of_row));
      for (Eigen::Index row = 0; row < right.size(); ++row) right[row] = vote_weight * votes[place(row)];
      const Eigen::VectorXd solution = solver.solve(right);
      if (solver.info() != Eigen::Success) {
        throw Error(ErrorKind::failure, "fuse.diffusion.diverged", "the diffusion of a class's votes does not converge",
                    "raise propagate.vote_weight, propagate.color_sigma or propagate.normal_sigma");
      }
      for (Eigen::Index row = 0; row < right.size(); ++row)
        out.probability[place(row)] = static_cast<float>(solution[row]);
      const std::lock_guard lock(told);
      if (done) done(++solved, static_cast<int>(asked.size()));
    }
  });
  for (std::size_t n = 0; n < nodes; ++n) normalise(std::span(out.probability).subspan(n * width, width));
  return out;
}

}  // namespace semfield
