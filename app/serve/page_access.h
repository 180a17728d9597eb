// Who has access: whoever knows the secret folder of the address, from a page of this server.
#pragma once

#include <optional>
#include <string>

#include "app/serve/http_server.h"

namespace semfield::app {

/// 32 hexadecimal digits of 128 random bits from the kernel. Throws Error(unavailable) where it has none.
std::string new_token();

/// The token of a run: made once and kept in `run_dir`/serve_token, for its user alone, so that a page that is open
/// goes on when the program starts again. One that others may read is replaced. Throws as new_token, and write_error.
std::string kept_token(const std::string& run_dir);

class PageAccess {
 public:
  /// `address` and `port`: what the server is bound to.
  PageAccess(std::string token, std::string address, int port);

  /// None: the request may go on. A wrong token gives 404 without a detail; what follows is for whoever knows the
  /// token.
  std::optional<HttpResponse> refuse(const HttpRequest& head) const;
  /// What a path that was not refused names, below the secret folder: "" or "state".
  std::string name_of(const std::string& path) const { return path.substr(token_.size() + 2); }
  int port() const { return port_; }
  /// The address to open, with the token.
  std::string url() const;

 private:
  bool is_token(const std::string& path) const;
  bool is_host(const std::string& host) const;

  std::string token_, address_;
  int port_;
};

}  // namespace semfield::app
