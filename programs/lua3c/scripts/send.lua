id = 10
while true do
    n3c.tx(id, h3c.dIn(1)) -- lê a entrada 1 e publica na rede com id=10
end
