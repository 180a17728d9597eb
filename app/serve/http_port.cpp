// Which port the server may take, checked with the system before the server starts, so that a refusal has its cause.
#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include "app/serve/http_server.h"
#include "core/error.h"

namespace semfield::app {

namespace {

// 0, or errno of what refused. `port` 0 becomes the one that the system gave.
int try_port(const in_addr& address, int& port) {
  const int probe = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (probe < 0) return errno;
  sockaddr_in place{};
  place.sin_family = AF_INET;
  place.sin_addr = address;
  place.sin_port = htons(static_cast<std::uint16_t>(port));
  const int yes = 1;
  setsockopt(probe, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
  socklen_t size = sizeof place;
  int cause = 0;
  if (bind(probe, reinterpret_cast<const sockaddr*>(&place), sizeof place) != 0 || listen(probe, 1) != 0 ||
      getsockname(probe, reinterpret_cast<sockaddr*>(&place), &size) != 0)
    cause = errno;
  else
    port = ntohs(place.sin_port);
  close(probe);
  return cause;
}

}  // namespace

int free_port(const std::string& address, int port, bool next) {
  in_addr number{};
  if (inet_pton(AF_INET, address.c_str(), &number) != 1)
    throw Error(ErrorKind::usage, "serve.address.invalid",
                "--address " + address + ": expected an IPv4 address in numbers",
                "give 127.0.0.1 for this machine alone, or 0.0.0.0 for every network that it is in");
  const int last = next ? port + 99 : port;
  int cause = 0;
  for (int at = port; at <= last && at <= 65535; ++at) {
    int got = at;
    cause = try_port(number, got);
    if (cause == 0) return got;
    if (cause != EADDRINUSE) break;
  }
  const std::string place = address + ":" + std::to_string(port);
  if (cause == EADDRINUSE)
    throw Error(
        ErrorKind::unavailable, "serve.port.taken",
        next ? "the ports " + std::to_string(port) + " to " + std::to_string(last) + " of " + address + " are all taken"
             : "port " + std::to_string(port) + " of " + address + " is taken by another program",
        next ? "name a free one with --port N" : "end that program, name another port, or leave --port out");
  if (cause == EADDRNOTAVAIL)
    throw Error(ErrorKind::unavailable, "serve.address.foreign", "this machine has no address " + address,
                "see `ip address` for those that it has, or leave --address out");
  if (cause == EACCES)
    throw Error(ErrorKind::unavailable, "serve.port.privileged",
                "port " + std::to_string(port) + " may not be used by this user",
                "ports below 1024 belong to root: name a higher one with --port N");
  throw Error(ErrorKind::unavailable, "serve.port.failed", "cannot listen on " + place + ": " + std::strerror(cause),
              "try another --port, or see what limits this process: ulimit -n");
}

}  // namespace semfield::app
