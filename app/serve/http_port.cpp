#include "app/serve/http_port.h"

#include <arpa/inet.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <cstring>

#include "core/error.h"

namespace semfield::app {

int listen_at(const in_addr& address, int& port) {
  const int listener = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (listener < 0) return listener;
  sockaddr_in place{};
  place.sin_family = AF_INET;
  place.sin_addr = address;
  place.sin_port = htons(static_cast<std::uint16_t>(port));
  const int yes = 1;
  setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
  socklen_t size = sizeof place;
  if (bind(listener, reinterpret_cast<const sockaddr*>(&place), sizeof place) == 0 &&
      listen(listener, SOMAXCONN) == 0 && getsockname(listener, reinterpret_cast<sockaddr*>(&place), &size) == 0) {
    port = ntohs(place.sin_port);
    return listener;
  }
  const int cause = errno;
  close(listener);
  errno = cause;
  return -1;
}

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
    if (const int listener = listen_at(number, got); listener >= 0) {
      close(listener);
      return got;
    }
    cause = errno;
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
