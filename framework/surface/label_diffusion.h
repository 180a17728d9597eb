// Votes of some nodes of a weighted graph spread over all of it, by one linear system per class.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

namespace semfield {

struct GraphEdge {
  std::int32_t a = 0, b = 0;
  double weight = 0;  ///< above 0
};

struct Diffusion {
  std::vector<float> probability;  ///< [nodes * classes]; a row sums to 1, or is 0 where no vote can be reached
  std::int64_t parts = 0;          ///< connected parts of the graph
  std::int64_t parts_without_vote = 0;
};

/// Solves (L + D) p_c = v_c for every class c, L the graph's Laplacian, v_c the votes for c times `vote_weight` and D
/// the diagonal of all votes times `vote_weight`: the chance that a walker from a node, who takes edges and votes by
/// their weights, ends at a vote for c [Zhu03, with votes on nodes of their own; Grady06, with seeds that hold softly].
/// `votes` [nodes * classes], not negative. Conjugate gradients with an incomplete factor, classes in parallel; the
/// bits do not depend on threads. `done` gets the number of classes solved, from any thread but one at a time; may be
/// null. Throws Error(failure) when the iteration does not converge.
Diffusion diffuse_votes(std::span<const GraphEdge> edges, std::span<const double> votes, int classes,
                        double vote_weight, const std::function<void(int done, int of)>& done);

}  // namespace semfield
